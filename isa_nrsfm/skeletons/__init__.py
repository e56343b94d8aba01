"""Known layouts of landmarks: lines between points, left and right, which way is up.

The layouts are those of face, hand and body trackers and of annotated data sets.
`SKELETONS` has them by name, `find_skeleton` recognises the one of a table, and
figures, viewer and glTF draw it. Indices, edges and names are facts of the sources that
each `Skeleton` cites.
"""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

if TYPE_CHECKING:
    from isa_nrsfm.skeletons._files import (
        read_skeleton as read_skeleton,
        skeleton_of_names as skeleton_of_names,
    )
    from isa_nrsfm.skeletons._recognition import (
        SKELETONS as SKELETONS,
        find_skeleton as find_skeleton,
        get_skeleton as get_skeleton,
    )
    from isa_nrsfm.skeletons._skeleton import Skeleton as Skeleton
else:
    __getattr__, __dir__, __all__ = lazy_names(
        __name__,
        {
            "isa_nrsfm.skeletons._files": ["read_skeleton", "skeleton_of_names"],
            "isa_nrsfm.skeletons._recognition": [
                "SKELETONS",
                "find_skeleton",
                "get_skeleton",
            ],
            "isa_nrsfm.skeletons._skeleton": ["Skeleton"],
        },
    )
