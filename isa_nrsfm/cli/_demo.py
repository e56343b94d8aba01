"""The command demo: fit an artificial table of faces and compare with the truth."""

import shlex
from argparse import Namespace
from pathlib import Path

import numpy as np

from isa_nrsfm._compat import pandas as pd
from isa_nrsfm.cli._fit import fit_table
from isa_nrsfm.cli._options import PROGRAM, build_parser
from isa_nrsfm.cli._reading import drawing_options
from isa_nrsfm.cli._report import fit_title, text_of
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.metrics import affine_shape_error


def run(args: Namespace, warned: list[str]) -> str:
    """Fit artificial faces, and compare the result with the truth."""
    faces = make_face_tracks(400, n_components=3, random_state=0)
    table = pd.DataFrame(faces.data.round(2), columns=faces.feature_names)
    table.insert(0, "frame", [f"face{i:03d}" for i in range(len(table))])
    folder = Path(args.output)
    options = [
        *("fit", str(folder / "tracks.csv"), "--output", str(folder)),
        *["--force"] * args.force,
        *["--no-figures"] * args.no_figures,
        *drawing_options(args),
    ]
    started = Namespace(arguments=options, since=args.since)
    parsed = build_parser().parse_args(options, started)
    report, model = fit_table(parsed, warned, table=table)
    shapes = model.shapes(model.alpha_)
    rigid = np.broadcast_to(model.mean_shape_, shapes.shape)
    error, alone = (affine_shape_error(faces.shapes, each) for each in (shapes, rigid))
    truth = (
        f"the 3D shapes of the frames are off by {100 * error:.1f} % (the mean shape "
        f"alone: {100 * alone:.1f} %)"
    )
    again = shlex.join([PROGRAM, *options])
    rows = [*report["summary"], ["truth", "", truth], ["again", "", again]]
    return text_of(fit_title(report), rows)
