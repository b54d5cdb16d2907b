"""Candidates of all blocks, held against the original on the views that decide.

Errors of blocks add up in a picture: of each block it is what its own splats do, its surroundings
being the same in both pictures. So that one choice is made for the whole scene.
"""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nanogs._types import F64
from nanogs.fit.targets import as_target
from nanogs.method.choose import GROWTH_MARGIN, GROWTHS, quality
from nanogs.method.visibility import LUMA, SHOWN
from nanogs.metrics import ssim
from nanogs.pipeline.coarse import surroundings
from nanogs.pipeline.cuts import cut_block
from nanogs.pipeline.look import read_visible
from nanogs.pipeline.memory_blocks import ROUGH
from nanogs.pipeline.views import parts_of
from nanogs.pipeline.work import Members
from nanogs.raster.rendering import PreparedSplats, prepare, render, together
from nanogs.report import CandidateReport
from nanogs.splats import Splats
from nanogs.store.tables import Record, write_table

if TYPE_CHECKING:
    from nanogs.pipeline.work import Work

MOST = 100.0  # dB
Errors = list[tuple[float, float]]  # of each view: squares of a channel, and 1 - SSIM, summed up


def try_balances(work: "Work", name: str, block: int, level: int) -> Record:
    """Write how a block's cuts of all balances do.

    Args:
        work: The job, its budget known.
        name: Of the table.
        block: Its number.
        level: Of the result.
    """
    splats, rows = work.block(block)
    visible = read_visible(work, block)
    budget, forest = work.of_job("budget", level).facts["groups"], work.of_block("forest", block)
    models = []
    for number in range(len(work.balances)):
        labels = cut_block(work.scratch, forest, budget[number][block], number)
        groups = work.stored(Members(splats, rows, labels, visible))
        models.append(groups.grown(work.settings.parameters.growth))
    own = prepare(splats)
    del splats
    return write_table(
        work.scratch, name, {}, {"errors": _errors(work, block, own, visible, models)}
    )


def pick_balance(work: "Work", name: str, level: int) -> Record:
    """Write which balance does best in the whole scene, the first of equal ones."""
    trials = [record.facts["errors"] for record in work.of_blocks("trial", level)]
    growth = work.settings.parameters.growth
    reports = [
        _report(work, (trial[number] for trial in trials), balance, growth, reassigned=False)
        for number, balance in enumerate(work.balances)
    ]
    best = max(range(len(reports)), key=lambda number: reports[number]["quality"])
    return write_table(work.scratch, name, {}, {"balance": best, "candidates": reports})


def try_growths(work: "Work", name: str, block: int, level: int) -> Record:
    """Write how a block's groups do after reassignment, for every growth."""
    reassigned = work.settings.parameters.rounds > 0
    found = work.members(block, level, reassigned=reassigned)
    assert found.visible is not None  # noqa: S101 - this job looks
    groups = work.stored(found)
    own, visible = prepare(found.splats), found.visible
    del found
    models = [groups.grown(growth) for growth in growths(work.settings.parameters.growth)]
    return write_table(
        work.scratch, name, {}, {"errors": _errors(work, block, own, visible, models)}
    )


def choose(work: "Work", name: str, level: int) -> Record:
    """Write what is chosen: whether splats stay reassigned, and how much may grow.

    A reassignment that does not help is taken back; growths are then as they were.
    """
    parameters = work.settings.parameters
    picked = work.of_job("pick", level).facts
    balance = work.balances[picked["balance"]]
    usual = picked["candidates"][picked["balance"]]
    trials = [record.facts["errors"] for record in work.of_blocks("judge", level)]
    tried = [
        _report(work, (trial[number] for trial in trials), balance, growth, reassigned=True)
        for number, growth in enumerate(growths(parameters.growth))
    ]
    reports, winner = [*picked["candidates"], tried[0]], usual
    if tried[0]["quality"] > usual["quality"]:
        winner = tried[0]
        for further in tried[1:]:
            reports.append(further)
            if further["quality"] <= winner["quality"] + GROWTH_MARGIN:
                break
            winner = further
    facts = {
        "reassigned": winner["reassigned"],
        "growth": winner["growth"],
        "candidates": [{**each, "chosen": each is winner} for each in reports],
    }
    return write_table(work.scratch, name, {}, facts)


def growths(usual: float) -> list[float]:
    """The growths that are tried, the usual one first."""
    return [usual, *(more for more in GROWTHS if more > usual)]


def candidates_of(record: Record) -> tuple[CandidateReport, ...]:
    """The candidates of a choice, as reports have them."""
    return tuple(CandidateReport(**each) for each in record.facts["candidates"])


def _errors(
    work: "Work", block: int, own: PreparedSplats, visible: F64, models: Sequence[Splats]
) -> list[Errors]:
    """Of each model of a block its errors on the views that decide."""
    others = surroundings(work, block, ROUGH)
    errors: list[Errors] = [[] for _ in models]
    parts = parts_of(own, visible >= SHOWN, work.views.deciding)
    whole = together(own, others)
    targets = [as_target(render(whole, part), part) if part else None for part in parts]
    del whole
    for model, found in zip(models, errors, strict=True):
        prepared = together(prepare(model), others)
        for target in targets:
            if target is None:
                found.append((0.0, 0.0))
                continue
            wanted = target.image[..., :3] / np.float32(255)
            image = render(prepared, target.camera).shown()
            squares = float(np.square(wanted - image).sum(dtype=np.float64)) / 3
            pixels = target.camera.width * target.camera.height
            found.append((squares, pixels * (1 - ssim(wanted @ LUMA, image @ LUMA))))
    return errors


def _report(
    work: "Work", of_blocks: Iterable[Errors], balance: float, growth: float, *, reassigned: bool
) -> dict[str, Any]:
    """A `CandidateReport` as plain data, from the errors of all blocks."""
    pixels = np.array([camera.width * camera.height for camera in work.views.deciding])
    sums = np.sum([np.array(each) for each in of_blocks], axis=0)
    with np.errstate(divide="ignore"):
        psnrs = np.minimum(-10 * np.log10(sums[:, 0] / pixels), MOST)
    psnr, similar = float(psnrs.mean()), float(np.mean(1 - sums[:, 1] / pixels))
    return {
        "balance": balance, "reassigned": reassigned, "growth": growth, "psnr": psnr,
        "ssim": similar, "quality": quality(psnr, similar), "chosen": False,
    }  # fmt: skip
