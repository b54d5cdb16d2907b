"""One command over several files: what goes where, and what is said of those that fail."""

import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import typer

from nanogs.cleanup import cleaned_up
from nanogs.cli.blocks import DASH
from nanogs.cli.console import fail, notes_about, print_json
from nanogs.cli.failures import sentence_of
from nanogs.cli.fetching import a_bar, within
from nanogs.cli.file_options import Files
from nanogs.cli.options import TransferProgress
from nanogs.cli.progress import Watch, shown
from nanogs.cli.streams import Streams
from nanogs.cli.wording import wording
from nanogs.errors import NanogsError, OptionError, OutputError
from nanogs.formatting import counted
from nanogs.io import registry
from nanogs.io.collect import Pair, collect, model_in, pair_up
from nanogs.progress import Progress
from nanogs.quantities import is_unit


@dataclass(frozen=True, slots=True)
class Run:
    """Outcome of a run on one file: the library's report, and what the command adds.

    Attributes:
        report: The library's, a dataclass with `to_dict`.
        files: What the command says beside it: `input`, `output` and their sizes among others.
    """

    report: Any
    files: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """All of it, for JSON."""
        told: dict[str, Any] = self.report.to_dict() | self.files
        return told

    def named(self, pair: Pair) -> "Run":
        """With the names of streams in place of files that stand in for them."""
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
            raise OptionError("- is one model and does not go with --out-dir; name files.")
        return pair_up(collect(paths), out_dir, suffix)
    if suffix is not None:
        raise OptionError("--format goes with --out-dir; without it the suffix of OUT decides.")
    if len(paths) == 1:
        raise OptionError(
            f"OUT is missing: name the file to write after {paths[0]}, or give --out-dir FOLDER."
        )
    if len(paths) != 2:
        raise OptionError(
            f"Give IN and OUT, or several inputs and --out-dir FOLDER; these are {len(paths)}"
            " paths without it."
        )
    return [Pair(model_in(paths[0]), paths[1])]


def refuse_units(paths: Sequence[Path]) -> None:
    """Refuse the second half of a number that was typed as two words, such as `--size 2 MB`.

    Raises:
        OptionError: A path is a unit, and no file.
    """
    for path in paths:
        if is_unit(str(path)) and not path.exists():
            raise OptionError(
                f"{path} is a unit and no file: write number and unit as one word, as in 2{path}."
            )


def run_all(
    pairs: list[Pair],
    run_one: Callable[[Pair, Progress], Run],
    show: Callable[[Run], None],
    telling: TransferProgress,
    files: Files,
    *,
    writes: bool = True,
    overwrite: bool = False,
) -> list[Run]:
    """Do one file after the other; of several, the failure of one leaves the others alone.

    Args:
        pairs: What is read and written.
        run_one: Does one of them, and tells its progress.
        show: Says to people what became of one.
        telling: What is said; with a model on stdout, JSON goes to stderr.
        files: The folder for several, and the formats of stdin and stdout.
        writes: Whether anything is written, and the folder made for it.
        overwrite: Whether what is at a URL may be replaced; of files `run_one` knows.

    Raises:
        NanogsError: The only file failed, or the folder cannot be made.
        typer.Exit: With code 2, one of several failed.
    """
    out_dir, streams = files.out_dir, Streams(files.read_as, files.write_as)
    failed: list[dict[str, str]] = []
    if out_dir is None:
        bar = a_bar(quiet=telling.hushed)
        with (
            streams.local_copies(pairs[0], bar, overwrite=overwrite) as near,
            shown(quiet=telling.hushed) as watch,
            streams.opened(near) as real,
        ):
            runs = [run_one(real, watch).named(pairs[0])]
    else:
        for pair in pairs:
            streams.check(pair)
        made = _make(out_dir) if writes else []
        with cleaned_up(partial(_remove_empty, made)), shown(quiet=telling.hushed) as watch:
            told = None if telling.hushed else show
            runs, failed = _run_several(pairs, run_one, told, watch, streams)
    if telling.json:
        each = [run.to_dict() for run in runs]
        data = each[0] if out_dir is None else {"files": each, "failed": failed}
        print_json(data, sys.stderr if pairs[0].target == DASH else sys.stdout)
    elif out_dir is None and not telling.quiet:
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
    """The runs, and of each file that failed its name and why."""
    runs: list[Run] = []
    failed: list[dict[str, str]] = []
    for number, pair in enumerate(pairs, 1):
        name = str(pair.source)
        try:
            told = watch.of_file(number, len(pairs))
            with notes_about(name), streams.local_copies(pair, within(told)) as near:
                registry.reader(near.source)  # which says so first where it is no model
                runs.append(run_one(near, told))
                if show:
                    show(runs[-1])
        except Exception as error:
            said = wording(error) if isinstance(error, NanogsError) else sentence_of(error)
            if said is None:
                raise
            fail(said if name in said else f"{name}: {said}")
            failed.append({"input": name, "error": said})
    return runs, failed


def _remove_empty(made: Sequence[Path]) -> None:
    """Take folders away, each before the one it is in, unless one holds something."""
    for folder in made:
        with suppress(OSError):
            folder.rmdir()


def _make(folder: Path) -> list[Path]:
    """Make a folder and those above it; which were missing, from it upwards."""
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        _remove_empty(missing)
        reason = error.strerror or str(error)
        raise OutputError(f"{folder} cannot be made ({reason}); choose another folder.") from error
    return missing
