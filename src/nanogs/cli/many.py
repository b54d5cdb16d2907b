"""Running a command on one or several files: inputs and outputs, reports and failures."""

import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import typer

from nanogs.cleanup import cleaned_up
from nanogs.cli.blocks import DASH
from nanogs.cli.console import fail, notes_about, print_json
from nanogs.cli.failures import sentence_of
from nanogs.cli.fetching import transfer_bar, within
from nanogs.cli.file_options import Files
from nanogs.cli.options import Reporting
from nanogs.cli.progress import Watch, shown
from nanogs.cli.streams import Streams
from nanogs.cli.wording import wording
from nanogs.errors import NanogsError, OptionError, OutputError
from nanogs.formatting import counted
from nanogs.io import registry
from nanogs.io.collect import Pair, collect, model_in, pair_up
from nanogs.io.folder import make_folders, remove_empty
from nanogs.progress import Progress
from nanogs.quantities import is_unit


@dataclass(frozen=True, slots=True)
class Run:
    """The result of a run on one file.

    Attributes:
        report: The library's report, a dataclass with `to_dict`.
        files: Entries that the command adds, such as `input`, `output` and their sizes.
    """

    report: Any
    files: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return report and added entries, for JSON."""
        record: dict[str, Any] = self.report.to_dict() | self.files
        return record

    def named(self, pair: Pair) -> "Run":
        """Return the run with "stdin" and "stdout" instead of their temporary files."""
        called = {"input": (pair.source, "stdin"), "output": (pair.target, "stdout")}
        named = {key: name for key, (path, name) in called.items() if path == DASH}
        return Run(self.report, self.files | {k: v for k, v in named.items() if k in self.files})


def plan_pairs(paths: list[Path], files: Files) -> list[Pair]:
    """Pair each input with its output.

    Raises:
        NanogsError: The files and options do not go together, or names collide.
    """
    out_dir, suffix = files.out_dir, files.out_format
    refuse_units(paths)
    if out_dir is not None:
        if DASH in paths:
            raise OptionError(
                "- cannot be combined with --out-dir, because a pipe holds one model; name files."
            )
        if (given := files.write_as) is not None:
            raise OptionError(
                f"--to is the format of a pipe; with --out-dir, give --format {given} instead."
            )
        return pair_up(collect(paths), out_dir, suffix)
    if suffix is not None:
        raise OptionError(
            "--format works only with --out-dir; leave it out and choose the format by the suffix"
            " of OUT."
        )
    if len(paths) == 1:
        raise OptionError(
            f"OUT is missing: name the file to write after {paths[0]}, or give --out-dir FOLDER."
        )
    if len(paths) != 2:
        _refuse_numbers(paths)
        raise OptionError(
            f"{len(paths)} paths were given without --out-dir; give IN and OUT, or several inputs"
            " and --out-dir FOLDER; `nanogs simplify A B OUT --join` makes one scene of several."
        )
    return [Pair(model_in(paths[0]), paths[1])]


def refuse_units(paths: Sequence[Path]) -> None:
    """Refuse a unit among the paths, as from `--size 2 MB`, typed as two words.

    Raises:
        OptionError: A path is a unit typed after a number, and not an existing file.
    """
    for number, unit in pairwise(sys.argv):
        path = Path(unit)
        follows = re.fullmatch(r"[\d.]+", number) and is_unit(unit)
        if follows and path in paths and not path.exists():
            raise OptionError(
                f"{unit} is a unit, not a file: write number and unit as one word, as in"
                f" {number}{unit}."
            )


def _refuse_numbers(paths: Sequence[Path]) -> None:
    """Refuse a number among the paths, as from `simplify IN OUT 0.1`, typed without its option.

    Raises:
        OptionError: A path is a number, and not an existing file.
    """
    for path in paths:
        if re.fullmatch(r"\d*\.?\d+[%kM]?", str(path)) and not path.exists():
            raise OptionError(
                f"{path} is a number, not a file: write its option before it, as in --ratio 0.1."
            )


def run_all(
    pairs: list[Pair],
    run_one: Callable[[Pair, Progress], Run],
    show: Callable[[Run], None],
    reporting: Reporting,
    files: Files,
    *,
    writes: bool = True,
    overwrite: bool = False,
) -> list[Run]:
    """Run a command on each file in turn; if one of several fails, the others are still done.

    Args:
        pairs: Inputs and outputs.
        run_one: Processes one pair, and reports its progress.
        show: Prints the result of one pair for people.
        reporting: Options of the output; with a model on stdout, JSON goes to stderr.
        files: The folder for several results, and the formats of stdin and stdout.
        writes: Whether files are written, so that the folder is created.
        overwrite: Whether an upload may replace what is at its URL; `run_one` checks files itself.

    Raises:
        NanogsError: The only file failed, or the folder cannot be created.
        typer.Exit: With code 2: one of several files failed.
    """
    out_dir, streams = files.out_dir, Streams(files.read_as, files.write_as)
    failed: list[dict[str, str]] = []
    if out_dir is None:
        bar = transfer_bar(quiet=reporting.hushed)
        with (
            streams.local_copies(pairs[0], bar, overwrite=overwrite) as near,
            shown(quiet=reporting.hushed) as watch,
            streams.opened(near) as real,
        ):
            runs = [run_one(real, watch).named(pairs[0])]
    else:
        for pair in pairs:
            streams.check(pair)
        made = _make(out_dir) if writes else []
        with cleaned_up(partial(remove_empty, made)), shown(quiet=reporting.hushed) as watch:
            show_each = None if reporting.hushed else show
            runs, failed = _run_several(pairs, run_one, show_each, watch, streams)
    if reporting.json:
        each = [run.to_dict() for run in runs]
        data = each[0] if out_dir is None else {"files": each, "failed": failed}
        print_json(data, sys.stderr if pairs[0].target == DASH else sys.stdout)
    elif out_dir is None and not reporting.quiet:
        show(runs[0])
    if failed:
        others = "; the others are done" if len(failed) < len(pairs) else ""
        fail(f"{len(failed)} of {counted(len(pairs), 'file')} failed{others}.")
        raise typer.Exit(2)
    return runs


def _run_several(
    pairs: list[Pair],
    run_one: Callable[[Pair, Progress], Run],
    show: Callable[[Run], None] | None,
    watch: Watch,
    streams: Streams,
) -> tuple[list[Run], list[dict[str, str]]]:
    """Return the runs, and for each file that failed its name and the error."""
    runs: list[Run] = []
    failed: list[dict[str, str]] = []
    for number, pair in enumerate(pairs, 1):
        name = str(pair.source)
        try:
            on_step = watch.of_file(number, len(pairs))
            with notes_about(name), streams.local_copies(pair, within(on_step)) as near:
                registry.reader(near.source)  # raises first of all if it is not a model
                runs.append(run_one(near, on_step))
                if show:
                    show(runs[-1])
        except Exception as error:
            said = wording(error) if isinstance(error, NanogsError) else sentence_of(error)
            if said is None:
                raise
            fail(said if name in said else f"{name}: {said}")
            failed.append({"input": name, "error": said})
    return runs, failed


def _make(folder: Path) -> list[Path]:
    """Create a folder with its parents, and return those that were missing, innermost first."""
    try:
        return make_folders(folder)
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError(f"{folder} cannot be made ({reason}); choose another folder.") from error
