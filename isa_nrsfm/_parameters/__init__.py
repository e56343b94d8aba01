"""Permitted values of the parameters of the public classes."""
