"""The Euclidean metric of space that cameras tell."""
