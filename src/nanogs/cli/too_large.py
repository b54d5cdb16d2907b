"""Options about models larger than memory, and whether a model is one."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nanogs.cli.simplify_report import Plan
from nanogs.cli.streams import DASH
from nanogs.errors import NotEnoughMemoryError, OptionError
from nanogs.filters import Filter
from nanogs.formatting import bytes_text
from nanogs.io.collect import Pair
from nanogs.memory import Memory, allowed_memory, process_memory
from nanogs.method.paper.parameters import PaperParameters


@dataclass(frozen=True, slots=True)
class Blocks:
    """How models are treated that do not fit.

    Attributes:
        memory: What the work may take, of what is free or of --max-memory.
        max_memory: Bytes of a process as given, or None.
        piped: Whether a model comes from stdin or goes to stdout.
        joined: Inputs that are parts of one scene, or none.
        job: The job folder, or None for that beside the output.
        resume: Whether a job is continued.
        workers: Processes of this machine, or None.
        scheduler: Address of a Dask scheduler, or None.
        given: What the library takes beside.
    """

    memory: Memory
    max_memory: int | None
    piped: bool
    joined: tuple[Path, ...]
    job: Path | None
    resume: bool
    workers: int | None
    scheduler: str | None
    given: dict[str, Any]

    def needed(self, plan: Plan, target: Path) -> bool:
        """Whether a model takes more memory than there is, or was begun so before."""
        if self.max_memory is None and self._begun(target):
            return True
        return plan.memory().peak > self.memory.bytes

    def process_memory(self, target: Path) -> int | None:
        """Bytes that each process may take; None where the library finds it.

        Args:
            target: What is written, beside which a job may be that was begun.
        """
        if self.max_memory is not None or self.scheduler or self._begun(target):
            return self.max_memory
        return process_memory(self.memory, self.workers or 1)

    def size_of_blocks(self, target: Path) -> tuple[int | None, int | None]:
        """The memory that decides the size of the blocks, as `block_memory` takes it."""
        from nanogs.pipeline.folder import job_folder
        from nanogs.pipeline.in_blocks import block_memory

        folder = job_folder(target, self.job) if self.resume else None
        allowed = self.process_memory(target)
        return block_memory(allowed, None, folder, elsewhere=self.scheduler is not None)

    def threads(self, given: int | None) -> int | None:
        """Threads of each process: by default those of the machine, shared by its workers."""
        if given is None and self.workers is not None:
            return max((os.cpu_count() or 1) // self.workers, 1)
        return given

    def reason(self, plan: Plan, target: Path) -> str:
        """Why a model is simplified in blocks, where nobody has said so; otherwise nothing."""
        allowed = self.process_memory(target)
        if self.max_memory is not None or allowed is None:
            return ""
        return (
            f"{plan.name} takes about {bytes_text(plan.memory().peak)} of memory, and"
            f" {self.memory}: it is simplified in blocks, as with --max-memory"
            f" {allowed / 1e6:g}MB."
        )

    def unused(self) -> list[str]:
        """Say that options for blocks had no effect on a model that is held whole."""
        named = {"--job": self.job, "--resume": self.resume, "--scratch": self.given["scratch"]}
        named |= {"--workers": self.workers, "--scheduler": self.scheduler}
        found = " and ".join(option for option, value in named.items() if value)
        if not found:
            return []
        if self.max_memory is not None:
            return [f"The model fits into --max-memory and needs no blocks: {found} had no effect."]
        note = (
            "The model fits into memory, so it is simplified in one process and not in blocks:"
            f" {found} had no effect; --max-memory makes blocks."
        )
        return [note]

    def _begun(self, target: Path) -> bool:
        """Whether there is a job in blocks to continue."""
        if not self.resume:
            return False
        from nanogs.pipeline.folder import MANIFEST, job_folder

        return (job_folder(target, self.job) / MANIFEST).exists()

    def sources(self, pair: Pair) -> tuple[Path, ...]:
        """The files that make up the model."""
        return self.joined or (pair.source,)

    def is_begun(self, target: Path, *, overwrite: bool) -> bool:
        """Whether there is a job to continue, which sees to its output itself.

        Raises:
            OutputError: There is none to continue, but an output.
        """
        if not self.resume:
            return False
        from nanogs.pipeline.folder import job_folder, refuse_finished

        if not overwrite:
            refuse_finished(job_folder(target, self.job), target)
        return self._begun(target)

    def refuse_fitting(self, target: Path) -> None:
        """Refuse to simplify in memory what was begun in blocks.

        Raises:
            OptionError: There is a job to continue.
        """
        if self._begun(target):
            from nanogs.pipeline.folder import job_folder

            raise OptionError(
                f"{job_folder(target, self.job)} holds a job in blocks, and this model fits into"
                " the memory given; resume it with the --max-memory it was begun with, or remove"
                " the folder."
            )


def parse_blocks(
    paths: Sequence[Path],
    max_memory: int | None,
    *,
    join: bool,
    job: Path | None,
    resume: bool,
    scratch: str | None,
    workers: int | None,
    scheduler: str | None,
    patience: float,
) -> Blocks:
    """Check what was asked for, as far as that is possible without the inputs.

    Raises:
        OptionError: The options do not go together.
    """
    if workers is not None and scheduler is not None:
        raise OptionError("Give --workers or --scheduler, not both.")
    if (max_memory is not None or join) and DASH in paths:
        raise OptionError("With --max-memory or --join models are files; name them in place of -.")
    if join and len(paths) < 2:
        raise OptionError("--join takes the parts of a scene and OUT; this is one path.")
    rest = {"scratch": scratch, "patience": patience}
    joined, piped = tuple(paths[:-1]) if join else (), DASH in paths
    return Blocks(
        allowed_memory(max_memory), max_memory, piped, joined, job, resume, workers, scheduler, rest
    )


def refuse_other_files(suffix: str) -> None:
    """Refuse levels in files that are not written block by block.

    Raises:
        OptionError: They are not of .ply.
    """
    if suffix != ".ply":
        raise OptionError(
            f"This model does not fit into memory, and levels made in blocks are .ply files, not"
            f" {suffix}; leave --format out, or name OUT lod-meta.json."
        )


def refuse_whole_model_wishes(
    plan: Plan,
    blocks: Blocks,
    *,
    filters: Sequence[Filter],
    measured: bool = False,
) -> None:
    """Refuse what only a model in memory can be asked.

    Args:
        plan: Of the run.
        blocks: How models are treated that do not fit.
        filters: What leaves out splats.
        measured: Whether the result is to be measured.

    Raises:
        NotEnoughMemoryError: Something asked for needs the whole model.
    """
    wishes = {
        "--size": plan.goal.size is not None,
        "--psnr": plan.goal.psnr is not None,
        "--drop-floaters": any(each.whole for each in filters),
        "--measure": measured,
        "a model in a pipe, which blocks cannot read or write,": blocks.piped,
        f"the preset {plan.preset}": isinstance(plan.parameters, PaperParameters),
    }
    for wish, asked in wishes.items():
        if asked:
            raise NotEnoughMemoryError(
                f"{plan.name} takes about {bytes_text(plan.memory().peak)} of memory, and"
                f" {blocks.memory}; blocks would take less, but {wish} needs the whole model: leave"
                " that out, or give it more memory."
            )
