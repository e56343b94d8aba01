"""Measure all methods side by side: ``python -m benchmarks``."""

import argparse
import os
from pathlib import Path

from benchmarks._data import data_folder, data_path
from benchmarks._figures import draw_reprojections
from benchmarks._jobs import Limits, run_jobs
from benchmarks._markdown import footnote, number
from benchmarks._methods import METHOD_TITLES
from benchmarks._results import FILE, Results
from benchmarks._sections import SECTIONS
from benchmarks._sets import SET_TITLES, SETS, is_present

OUTPUT = Path(__file__).resolve().parents[1] / "docs" / "benchmarks"
PREAMBLE = "Written by `python -m benchmarks`; [README](README.md) says what it does.\n"


def parse(arguments=None):
    """Return the options of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Measure all methods side by side.",
        epilog=f"Sections: {', '.join(SECTIONS)}. Sets: {', '.join(SETS)}. Methods: "
        + "; ".join(f"{', '.join(s.methods)} ({name})" for name, s in SECTIONS.items())
        + ". Sets are read from the folder that ISA_NRSFM_DATA names.",
    )
    add = parser.add_argument
    add("sections", nargs="*", metavar="section", help="what to measure; default all")
    add("--sets", nargs="+", metavar="set", help="default all of the section")
    add("--methods", nargs="+", metavar="method", help="default all of the section")
    add("--repeats", type=int, default=3, help="seeds of random methods (default 3)")
    add(
        "--time-limit",
        type=float,
        default=600.0,
        metavar="SECONDS",
        help="of a fit (default 600)",
    )
    add(
        "--memory-limit",
        type=float,
        metavar="GB",
        help="of address space of a run (default none)",
    )
    add(
        "--jobs",
        type=int,
        default=min(2, os.cpu_count() or 1),
        metavar="N",
        help="runs at a time (default %(default)s)",
    )
    add(
        "--threads",
        type=int,
        default=1,
        metavar="N",
        help="threads of the linear algebra of a run (default 1)",
    )
    add(
        "--output",
        type=Path,
        default=OUTPUT,
        metavar="FOLDER",
        help="of results.json, where results of earlier runs are kept unless measured "
        "again, of tables and pictures (default docs/benchmarks)",
    )
    add("--tables-only", action="store_true", help="write them from results.json anew")
    options = parser.parse_args(arguments)
    options.sections = options.sections or list(SECTIONS)
    check(parser, "section", options.sections, SECTIONS)
    chosen = [SECTIONS[name] for name in options.sections]
    known = [name for s in chosen for name in (*s.sets, *s.other_sets)]
    check(parser, "set", options.sets or (), known)
    known = [name for s in chosen for name in (*s.methods, *s.other_methods)]
    check(parser, "method", options.methods or (), known)
    if options.repeats < 1 or options.jobs < 1 or options.threads < 1:
        parser.error("--repeats, --jobs and --threads must be 1 or more")
    return options


def check(parser, kind, names, known):
    """Refuse names that are not known."""
    unknown = sorted(set(names) - set(known))
    if unknown:
        listed = ", ".join(dict.fromkeys(known))
        parser.error(f"no {kind} {', '.join(unknown)} here; there are {listed}")


def chosen_jobs(section, options):
    """Return the jobs of a section; absent sets are named and skipped."""
    what = SECTIONS[section]
    names = what.sets
    if options.sets:
        names = [
            name for name in options.sets if name in (*what.sets, *what.other_sets)
        ]
    methods = what.methods
    if options.methods:
        known = (*what.methods, *what.other_methods)
        methods = [name for name in known if name in options.methods]
    present = [name for name in names if is_present(name)]
    if absent := [name for name in names if name not in present]:
        files = ", ".join(data_path(SETS[name].case).name for name in absent)
        print(
            f"{section}: {len(absent)} of {len(names)} sets are skipped, because "
            f"{data_folder()} (ISA_NRSFM_DATA) has no {files}. Measured: "
            f"{', '.join(present) or 'nothing'}",
            flush=True,
        )
    return what.jobs(section, present, methods, options.repeats)


def progress(record):
    """Return what became of a run, in a line."""
    parts = [record.section, record.set, record.method, f"seed {record.seed}"]
    parts += [f"{name} {setting}" for name, setting in record.parameters.items()]
    if record.status != "ok":
        return f"{' '.join(parts)}: {record.message}"
    numbers = [
        f"{name} {number(figure)}"
        for name, figure in record.values.items()
        if isinstance(figure, float)
    ]
    used = f"{record.seconds:.2f} s, {record.memory:.0f} MB"
    return f"{' '.join(parts)}: {'; '.join([used, *numbers])}"


def measure(section, options, results):
    """Run a section, and keep its results as they come."""
    jobs = chosen_jobs(section, options)
    limits = Limits(options.time_limit, options.memory_limit, options.threads)
    environment = results.begin(
        threads=options.threads, runs_at_a_time=options.jobs, time_limit=limits.time
    )
    shown = {}
    for i, (record, arrays) in enumerate(
        run_jobs(jobs, limits, options.jobs, environment), start=1
    ):
        results.add(record)
        results.save()
        print(f"[{i}/{len(jobs)}] {progress(record)}", flush=True)
        if arrays and record.seed == 0:
            shown.setdefault(record.set, {})[record.method] = arrays
    if section == "reprojection":
        for name, by_method in shown.items():
            path = options.output / f"reprojection_{name}.png"
            titles = {m: t for m, t in METHOD_TITLES.items() if m != "floor"}
            origin = SETS[name].origin
            draw_reprojections(by_method, titles, SET_TITLES[name], path, origin)


def write(section, results, folder):
    """Write the page and the pictures of a section, if it has records."""
    what, records = SECTIONS[section], results.of(section)
    if not records:
        return
    files = what.draw(records, folder)
    if section == "reprojection":
        files += [
            f"reprojection_{name}.png"
            for name in SETS
            if (folder / f"reprojection_{name}.png").is_file()
        ]
    pictures = "\n".join(f"![{Path(file).stem}]({file})\n" for file in files)
    text = "\n".join(
        [
            f"# {what.title}\n",
            PREAMBLE,
            what.page(records),
            pictures,
            footnote(results, records),
        ]
    )
    (folder / f"{section}.md").write_text(text, encoding="utf-8")
    print(f"wrote {folder / section}.md", flush=True)


def main(arguments=None):
    """Measure, and write tables and pictures."""
    options = parse(arguments)
    results = Results(options.output / FILE)
    for section in options.sections:
        if not options.tables_only:
            measure(section, options, results)
        write(section, results, options.output)


if __name__ == "__main__":
    main()
