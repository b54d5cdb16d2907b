"""What is asked for models that do not fit into the memory given, and whether one does not."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nanogs.cli import options
from nanogs.cli.simplify_report import Plan
from nanogs.cli.streams import DASH
from nanogs.defaults import DEFAULT_MEMORY
from nanogs.errors import OptionError
from nanogs.formatting import bytes_text
from nanogs.io.collect import Pair
from nanogs.simplify.memory import LIBRARIES


@dataclass(frozen=True, slots=True)
class Blocks:
    """How models are treated that do not fit.

    Attributes:
        max_memory: Bytes of a process, or None where models are held whatever they take.
        joined: Inputs that are parts of one scene, or none.
        job: The job folder, or None for that beside the output.
        resume: Whether a job is continued.
        given: What the library takes beside.
    """

    max_memory: int | None
    joined: tuple[Path, ...]
    job: Path | None
    resume: bool
    given: dict[str, Any]

    def needed(self, plan: Plan) -> bool:
        """Whether a model takes more memory than there is."""
        return self.max_memory is not None and plan.memory().peak + LIBRARIES > self.max_memory

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
        from nanogs.scale.folder import MANIFEST, job_folder, refuse_finished

        folder = job_folder(target, self.job)
        if not overwrite:
            refuse_finished(folder, target)
        return (folder / MANIFEST).exists()

    def refuse_fitting(self, target: Path) -> None:
        """Refuse to simplify in memory what was begun in blocks.

        Raises:
            OptionError: There is a job to continue.
        """
        if not self.resume:
            return
        from nanogs.scale.folder import MANIFEST, job_folder

        folder = job_folder(target, self.job)
        if (folder / MANIFEST).exists():
            raise OptionError(
                f"{folder} holds a job in blocks, and this model fits into the memory given; resume"
                " it with the --max-memory it was begun with, or remove the folder."
            )


def parse_blocks(
    paths: Sequence[Path],
    max_memory: str | None,
    *,
    join: bool,
    job: Path | None,
    resume: bool,
    scratch: str | None,
    workers: int | None,
    scheduler: str | None,
    patience: float,
) -> Blocks:
    """What was asked for, checked as far as it can be without the inputs.

    Raises:
        OptionError: The options do not go together.
    """
    far = workers is not None or scheduler is not None
    given = bool(job) or resume or scratch is not None or far
    memory = None if max_memory is None else options.parse_memory(max_memory)
    if memory is None and given:
        memory = DEFAULT_MEMORY
    if workers is not None and scheduler is not None:
        raise OptionError("Give --workers or --scheduler, not both.")
    if (memory is not None or join) and DASH in paths:
        raise OptionError("With --max-memory or --join models are files; name them in place of -.")
    if join and len(paths) < 2:
        raise OptionError("--join takes the parts of a scene and OUT; this is one path.")
    rest: dict[str, Any] = {"scratch": scratch, "workers": workers, "scheduler": scheduler}
    rest["patience"] = patience
    return Blocks(memory, tuple(paths[:-1]) if join else (), job, resume, rest)


def refuse_other_files(suffix: str) -> None:
    """Refuse levels in files that are not written block by block.

    Raises:
        OptionError: They are not of .ply.
    """
    if suffix != ".ply":
        raise OptionError(
            f"This model is larger than --max-memory, and levels made in blocks are .ply files, not"
            f" {suffix}; leave --format out, or name OUT lod-meta.json."
        )


def refuse_whole_model_wishes(
    plan: Plan, *, filtered: bool, looks: bool, turned: bool = False, reduced: bool = False
) -> None:
    """Refuse what only a model in memory can be asked.

    Args:
        plan: Of the run.
        filtered: Whether there are filters.
        looks: Whether views are asked for.
        turned: Whether the frame is changed.
        reduced: Whether spherical harmonics are dropped.

    Raises:
        OptionError: Something asked for needs the whole model.
    """
    wishes = {
        "--size": plan.goal.size is not None,
        "--psnr": plan.goal.psnr is not None,
        "a filter": filtered,
        "--views, --cameras or --up": looks,
        "--frame": turned,
        "--sh-degree": reduced,
    }
    for wish, asked in wishes.items():
        if asked:
            raise OptionError(
                f"This model takes {bytes_text(plan.memory().peak)}, more than --max-memory, and"
                f" {wish} needs the whole of it; raise --max-memory, or leave that out."
            )
