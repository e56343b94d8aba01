"""The Euclidean metric of space, from affine cameras."""
