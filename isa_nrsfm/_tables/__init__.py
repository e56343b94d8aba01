"""What comes in and where it lies: layouts, columns, blocks of frames."""
