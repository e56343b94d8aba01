"""The command demo: fit an artificial table of faces and compare with the truth."""

import shlex
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.utils import Bunch

from isa_nrsfm import AffineNRSfM
from isa_nrsfm._compat import pandas as pd
from isa_nrsfm.cli._fit import fit_table
from isa_nrsfm.cli._options import PROGRAM, build_parser
from isa_nrsfm.cli._reading import drawing_options
from isa_nrsfm.cli._sections import fit_text
from isa_nrsfm.datasets import make_face_tracks
from isa_nrsfm.metrics import affine_shape_error, basis_similarity


def run(args: Namespace, warned: list[str]) -> str:
    """Fit artificial faces, and compare the result with the truth."""
    faces = make_face_tracks(400, n_components=3, random_state=0)
    table = pd.DataFrame(faces.data.round(2), columns=faces.feature_names)
    table.insert(0, "frame", [f"face{i:03d}" for i in range(len(table))])
    folder = Path(args.output)
    options = [
        *("fit", str(folder / "tracks.csv"), "--n-components", "1-5"),
        *("--output", str(folder)),
        *["--force"] * args.force,
        *["--no-figures"] * args.no_figures,
        *drawing_options(args),
    ]
    started = Namespace(arguments=options, since=args.since)
    report = fit_table(
        build_parser().parse_args(options, started),
        warned,
        table=table,
        truth=lambda estimator, X: _compare(faces, estimator, X),
    )
    truth = report["truth"]
    width = max(map(len, faces.component_names))
    lines = [
        f"the 3D shapes of the frames are off by {100 * truth['shape_error']:.1f} % "
        f"(the mean shape alone: {100 * truth['mean_shape_error']:.1f} %)",
        *(
            f"{row['name']:{width}} is {row['found_as']}: similarity of the basis "
            f"shapes {row['similarity']:.2f}, correlation of the coefficients "
            f"{row['correlation']:.2f}"
            for row in truth["basis"]
        ),
    ]
    ending = {"Truth": lines, "Again": [shlex.join([PROGRAM, *options])]}
    return fit_text(report, folder, ending)


def _compare(faces: Bunch, estimator: AffineNRSfM, X: Any) -> dict[str, Any]:
    """Compare a fitted model with the truth."""
    shapes = estimator.reconstruct(X)
    rigid = np.broadcast_to(estimator.mean_shape_, shapes.shape)
    similarity, matching = basis_similarity(
        faces.basis,
        estimator.basis_,
        mean_shape_true=faces.mean_shape,
        mean_shape=estimator.mean_shape_,
        modulo_mean_shape=True,
        return_matching=True,
    )
    n_true, names = len(faces.basis), estimator.get_feature_names_out()
    correlation = np.corrcoef(faces.alpha.T, estimator.alpha_.T)[:n_true, n_true:]
    basis = {
        "name": faces.component_names,
        "found_as": names[matching],
        "similarity": similarity,
        "correlation": abs(correlation[range(n_true), matching]),
    }
    return {
        "shape_error": affine_shape_error(faces.shapes, shapes),
        "mean_shape_error": affine_shape_error(faces.shapes, rigid),
        "basis": pd.DataFrame(basis).to_dict("records"),
    }
