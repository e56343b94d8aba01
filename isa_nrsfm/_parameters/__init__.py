"""What the parameters of the public classes may be, for all who ask before a fit."""
