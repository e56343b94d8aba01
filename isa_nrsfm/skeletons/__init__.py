"""Known layouts of landmarks: lines between points, left and right, which way is up.

The layouts are those of face, hand and body trackers and of annotated data sets.
`SKELETONS` has them by name, `find_skeleton` recognises the one of a table, and
figures, viewer and glTF draw it. Indices, edges and names are facts of the sources that
each `Skeleton` cites.
"""

from isa_nrsfm.skeletons._recognition import (
    SKELETONS,
    Skeleton,
    find_skeleton,
    get_skeleton,
    read_skeleton,
    skeleton_of_names,
)

__all__ = [
    "SKELETONS",
    "Skeleton",
    "find_skeleton",
    "get_skeleton",
    "read_skeleton",
    "skeleton_of_names",
]
