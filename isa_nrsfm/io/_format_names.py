"""Names of the formats of landmark files, known without what reads them."""

# A table with named columns, which any program may have written.
TABLE = "table"
FORMAT_NAMES = (
    "openface",
    "pyfeat",
    "mediapipe",
    "pts",
    "wflw",
    "deeplabcut",
    "sleap",
    "coco",
    TABLE,
)
