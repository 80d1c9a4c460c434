"""Writes the report of whatever a folder holds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from crazyarena.bounded_read import read_json
from crazyarena.errors import InputError, StorageError
from crazyarena.plain_text import shown_line
from crazyarena.whole_file import write_whole

if TYPE_CHECKING:
    from crazyarena.runner.records.compare import Comparison

REPORT = "report.html"


def write_report(folder: Path, against: Path | None = None, out: Path | None = None) -> Path:
    """Write ``report.html`` into a folder of results, or to ``out``; returns the file.

    Parameters
    ----------
    folder: of a run, a bench, a comparison, a fault campaign or a validation.
    against: a run to compare a run with, such as its dry run.

    Raises
    ------
    InputError: it holds none of these. StorageError: the disk refuses.
    """
    target = out if out is not None else folder / REPORT
    write_whole(target, _page(folder, against))
    return target


def leave_page(folder: Path) -> tuple[str, str | None]:
    """Write ``report.html`` after a run; returns what to say of it, and a style if it failed."""
    try:
        return f"Report: {shown_line(str(write_report(folder)))}", None
    except (InputError, StorageError) as error:
        return f"Report: not written: {error}", "red"


def _page(folder: Path, against: Path | None) -> str:
    from crazyarena.runner.records.pages.compare_page import compare_page
    from crazyarena.runner.records.pages.run_page import bench_page, run_page
    from crazyarena.runner.records.pages.tables_page import campaign_page, validate_page

    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder. Pass a results folder")
    if (folder / "result.json").is_file():
        if against is None:
            against = _dry_run_of(folder)
        return run_page(folder, against)
    if against is not None:
        raise InputError(f"--against: {folder} is not the folder of one run")
    if any(folder.glob("bench_[0-9]*")):
        return bench_page(folder)
    if (folder / "campaign.json").is_file():
        return campaign_page(folder / "campaign.json")
    if (folder / "validate.json").is_file():
        return validate_page(folder / "validate.json")
    if (folder / "compare.json").is_file():
        return compare_page(_compared(folder / "compare.json"))
    raise InputError(
        f"{folder}: nothing to report. Pass the folder of a run, a bench, a comparison "
        "(compare.json), a fault campaign (campaign.json) or a validation (validate.json)"
    )


def _dry_run_of(folder: Path) -> Path | None:
    """The dry run of the same draw that a bench leaves beside each of its flights."""
    name = folder.resolve().name
    if not name.startswith("bench_"):
        return None
    beside = folder.resolve().parent / name.replace("bench_", "dry_", 1)
    return beside if (beside / "result.json").is_file() else None


def _compared(file: Path) -> Comparison:
    from crazyarena.runner.records.compare import compare

    document = read_json(file, "comparison")
    names, runs = (
        (document.get(key) if isinstance(document, dict) else None) for key in ("names", "runs")
    )
    if not (
        isinstance(names, list)
        and len(names) == 2
        and isinstance(runs, list)
        and len(runs) == 2
        and all(isinstance(group, list) for group in runs)
        and all(isinstance(run, str) for group in runs for run in group)
    ):
        raise InputError(f"{file}: does not name its runs; make it anew with crazyarena compare")
    first, second = ([Path(run) for run in group] for group in runs)
    return compare(first, second, (str(names[0]), str(names[1])), different_levels=True)
