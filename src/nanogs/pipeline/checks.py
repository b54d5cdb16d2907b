"""Checks of a request before anything is computed, whether its model is in memory or in blocks."""

from pathlib import Path
from typing import TYPE_CHECKING

from nanogs.card.device import AUTO, CPU, check_device
from nanogs.errors import OptionError
from nanogs.io import registry
from nanogs.pipeline.options.presets import Parameters, refuse_search, renders
from nanogs.pipeline.options.target import Goal, count_for_size
from nanogs.splats import Splats

if TYPE_CHECKING:
    from nanogs.pipeline.search.files import HeldFiles
    from nanogs.pipeline.search.size_request import SizeRequest


def refuse_device(device: str | None, preset: str, chosen: Parameters, goal: Goal) -> None:
    """Raise if a device is not available, or if it is a graphics card and nothing is rendered.

    Args:
        device: The device asked for; "auto" never raises.
        preset: Name of the preset.
        chosen: Its parameters.
        goal: The target of the simplification.

    Raises:
        OptionError: The device is not available, or has nothing to do.
    """
    looks = renders(chosen) or goal.psnr is not None
    if device not in (None, CPU, AUTO) and not looks:
        raise OptionError(
            f"`device` has no effect with the preset {preset}, which renders nothing; use"
            ' `device="cpu"`, or choose another preset.'
        )
    check_device(device)


def refuse_searches(goal: Goal, preset: str, path: Path) -> None:
    """Raise, before anything is read, if the goal needs a search that the preset cannot do.

    Args:
        goal: The target of the simplification.
        preset: Name of a preset.
        path: The output file; only its suffix counts.

    Raises:
        OptionError: The preset starts again for every count; the format cannot be written; or a
            size or a PSNR is asked for, and the format is not a single file.
    """
    if goal.psnr is not None:
        refuse_search(preset, "a PSNR")
    elif goal.draw_cost is not None:
        refuse_search(preset, "a draw cost")
    known = registry.writable(path)
    if goal.size is not None and known.file_bytes is None:
        refuse_search(preset, f"the size of a {known.suffix} file")
    if known.write is None and (goal.size is not None or goal.psnr is not None):
        asked = "size" if goal.psnr is None else "psnr"
        raise OptionError(
            f"`{asked}` works only for models in one file, and {known.suffix} describes a folder;"
            " write a .sog file."
        )


def refuse_reduced(goal: Goal, chosen: Parameters, sh_degree: int | None) -> None:
    """Raise if a PSNR is asked for and harmonics would be left out of the model before it is made.

    Args:
        goal: The target of the simplification.
        chosen: Parameters of the method.
        sh_degree: Degree of the result's harmonics, if one is asked for.

    Raises:
        OptionError: Both are asked for, and the method renders nothing, so that it cannot fit its
            results for the degree.
    """
    if goal.psnr is not None and sh_degree is not None and not renders(chosen):
        raise OptionError(
            "`psnr` cannot be combined with `sh_degree` for a preset that renders nothing, because"
            " the PSNR would be against a model without these harmonics; use the preset default, or"
            " leave the harmonics out with `nanogs convert` first."
        )


def refuse_small_size(request: "SizeRequest", some: Splats, files: "HeldFiles") -> None:
    """Raise, before anything is computed, if the file size asked for is far too small.

    Args:
        request: The requirements on the file.
        some: Usable splats of the model, at least one.
        files: Writes sample files to measure their size.

    Raises:
        TooSmallError: The size is far too small.
    """
    from nanogs.pipeline.search.file_size import refuse_hopeless

    smallest = request.smallest(some.sh_degree)
    lowest = some.with_sh_degree(smallest.sh_degree)
    if (file_bytes := request.known.file_bytes) is not None:
        count_for_size(1, request.size, lambda _count: file_bytes(lowest, 1))
    else:
        refuse_hopeless(
            lowest, request.size, lambda one: files.sample_bytes(one, smallest.options(1))
        )
