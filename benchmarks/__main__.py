"""Measure all methods side by side: ``python -m benchmarks``."""

import argparse
import os
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from benchmarks._agreement import AGREEMENT
from benchmarks._classification import CLASSIFICATION
from benchmarks._figures import draw_reprojections
from benchmarks._fits import BOUND, REPROJECTION, TRUTH_3D
from benchmarks._methods import METHOD_TITLES
from benchmarks._paper import PAPER
from benchmarks._results import environment, footnote, number, read, section_of, write
from benchmarks._run import rounded, run_isolated
from benchmarks._sets import SET_TITLES, SETS, data_folder, data_path, is_present
from benchmarks._sweeps import COSTS, RECOVERED
from benchmarks._unseen import HELD_OUT

SECTIONS = {
    "reprojection": REPROJECTION,
    "truth": TRUTH_3D,
    "recovery": RECOVERED,
    "held_out": HELD_OUT,
    "classification": CLASSIFICATION,
    "agreement": AGREEMENT,
    "cost": COSTS,
    "paper": PAPER,
}
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
    add("--time-limit", type=float, default=600.0, help="of a fit, s (default 600)")
    n_jobs = min(2, os.cpu_count() or 1)
    add("--jobs", type=int, default=n_jobs, help="runs at a time (default %(default)s)")
    add("--output", type=Path, default=OUTPUT, help="folder (default docs/benchmarks)")
    add("--tables-only", action="store_true", help="write them from results.json anew")
    options = parser.parse_args(arguments)
    options.sections = options.sections or list(SECTIONS)
    chosen = [SECTIONS[name] for name in options.sections if name in SECTIONS]
    for kind, names, known in (
        ("section", options.sections, SECTIONS),
        ("set", options.sets, [n for s in chosen for n in s.sets + s.other_sets]),
        (
            "method",
            options.methods,
            [n for s in chosen for n in s.methods + s.other_methods],
        ),
    ):
        if unknown := sorted(set(names or ()) - set(known)):
            listed = ", ".join(dict.fromkeys(known))
            parser.error(f"no {kind} {', '.join(unknown)} here; there are {listed}")
    if options.repeats < 1 or options.jobs < 1:
        parser.error("--repeats and --jobs must be 1 or more")
    return options


def chosen_runs(section, options):
    """Return the runs of a section; absent sets are named and skipped."""
    what = SECTIONS[section]
    names = what.sets
    if options.sets:
        names = [name for name in options.sets if name in what.sets + what.other_sets]
    methods = what.methods
    if options.methods:
        known = what.methods + what.other_methods
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
    return what.runs(present, methods, options.repeats)


def progress(record):
    """Return what became of a run, in a line."""
    parts = [record["section"], record["set"], record["method"]]
    parts += [f"seed {record['seed']}"]
    parts += [f"{name} {setting}" for name, setting in record["parameters"].items()]
    if record["status"] != "ok":
        return f"{' '.join(parts)}: {record['message']}"
    numbers = [
        f"{name} {number(figure)}"
        for name, figure in record["values"].items()
        if isinstance(figure, float)
    ]
    used = f"{record['seconds']:.2f} s, {record['memory']:.0f} MB"
    return f"{' '.join(parts)}: {'; '.join([used, *numbers])}"


def measure(section, options):
    """
    Run a section, and keep its results as they come.

    The first result of a set and a method replaces those of earlier calls.
    """
    path, function = options.output / "results.json", SECTIONS[section].measure
    stored, shown, replaced = read(path), {}, set()
    key, facts = environment(
        threads=1, runs_at_a_time=options.jobs, time_limit=options.time_limit
    )
    stored["environments"][key] = facts
    runs = chosen_runs(section, options)
    with ThreadPoolExecutor(options.jobs) as pool:
        futures = {}
        for name, method, seed, parameters in runs:
            run = {"name": name, "method": method, "seed": seed, **parameters}
            future = pool.submit(run_isolated, function, run, options.time_limit)
            record = {"section": section, "set": name, "method": method, "seed": seed}
            futures[future] = record | {"parameters": parameters, "environment": key}
        for i, future in enumerate(as_completed(futures), start=1):
            record = futures[future] | future.result()
            frames = record["values"].pop("shown", None)
            record["values"] = {k: rounded(v) for k, v in record["values"].items()}
            group = section, record["set"], record["method"]
            if group not in replaced:
                replaced.add(group)
                stored["records"] = [
                    r
                    for r in stored["records"]
                    if (r["section"], r["set"], r["method"]) != group
                ]
            stored["records"].append(record)
            write(path, stored)
            print(f"[{i}/{len(runs)}] {progress(record)}", flush=True)
            if frames and record["seed"] == 0 and record["method"] != BOUND:
                shown.setdefault(record["set"], {})[record["method"]] = frames
    if section == "reprojection":
        for name, by_method in shown.items():
            path = options.output / f"reprojection_{name}.png"
            heading, origin = SET_TITLES[name], SETS[name].origin
            draw_reprojections(by_method, METHOD_TITLES, heading, path, origin)


def write_page(section, stored, folder):
    """Write the page and the pictures of a section, if it has records."""
    what, records = SECTIONS[section], section_of(stored, section)
    if records.empty:
        return
    files = what.draw(records, folder) if what.draw else []
    if section == "reprojection":
        names = [f"reprojection_{name}.png" for name in SETS]
        files += [file for file in names if (folder / file).is_file()]
    text = "\n".join(
        [
            f"# {what.title}\n",
            PREAMBLE,
            what.page(records),
            "\n".join(f"![{Path(file).stem}]({file})\n" for file in files),
            footnote(stored["environments"], records),
        ]
    )
    (folder / f"{section}.md").write_text(text, encoding="utf-8")
    print(f"wrote {folder / section}.md", flush=True)


def main(arguments=None):
    """Measure, and write tables and pictures."""
    options = parse(arguments)
    for section in options.sections:
        if not options.tables_only:
            measure(section, options)
        stored = read(options.output / "results.json")
        write_page(section, stored, options.output)


if __name__ == "__main__":
    main()
