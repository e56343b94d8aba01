"""Input tables: layouts, columns, blocks of frames."""
