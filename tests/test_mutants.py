"""Changes that break a module: where, and what stands there afterwards."""

from benchmarks._mutants import mutants

TEXT = '''"""A module."""

LIMIT = 3


def turned(x: "float | None" = None) -> list[3]:
    if x < LIMIT and not x:
        raise ValueError("a" + f"{x + 1}")
    é = -x.T + 2.0
    return min(é, (
        x))


@dataclass(frozen=True)
class Pairs:
    both = zip((), (), strict=True)
'''


def test_each_place_is_changed_in_each_way():
    found = {(m.line, m.before, m.after) for m in mutants("module.py", TEXT)}
    assert found == {
        (3, "3", "4"),
        (3, "3", "2"),
        (7, "x < LIMIT and not x", "x < LIMIT or not x"),
        (7, "x < LIMIT", "x <= LIMIT"),
        (7, "x < LIMIT", "x > LIMIT"),
        (7, "not x", "x"),
        (9, "-x.T + 2.0", "-x.T - 2.0"),
        (9, "-x.T + 2.0", "-x.T"),
        (9, "-x.T + 2.0", "2.0"),
        (9, "-x.T", "x.T"),
        (9, "x.T", "x"),
        (9, "2.0", "4.0"),
        (10, "min(é, ( x))", "max(é, x)"),
    }
