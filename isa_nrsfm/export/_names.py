"""Names of coefficients."""

from typing import Any


def names_of_components(names: Any, n_components: int) -> list[str]:
    """Return the names of the coefficients, by default alpha_1, alpha_2, ...

    Numbers count from 1: number 0 is the mean shape.
    """
    if names is None:
        return [f"alpha_{k + 1}" for k in range(n_components)]
    names = [str(name) for name in names]
    if len(names) != n_components:
        raise ValueError(
            f"names must hold {n_components} names, one a basis shape; got {len(names)}"
        )
    return names
