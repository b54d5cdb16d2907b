"""How `nanogs simplify` shows its plan and its report."""

from dataclasses import asdict, dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from nanogs.cli.console import arrow, err, key_value_table, print_json, say, show, warn
from nanogs.cli.filtering import report_filters
from nanogs.formatting import bytes_text, counted, number_text, sizes_text, time_text
from nanogs.io import FileInfo, registry
from nanogs.memory import LIBRARIES
from nanogs.pipeline.memory import MemoryPlan, plan_memory
from nanogs.pipeline.presets import Parameters, effective, renders
from nanogs.pipeline.target import Goal
from nanogs.protocol import Judged, Protocol
from nanogs.report import StopReason

if TYPE_CHECKING:
    from nanogs.pipeline.encoding import Encoding

_LIBRARIES = f"{bytes_text(LIBRARIES)} for Python and its libraries"


@dataclass(frozen=True, slots=True)
class Plan:
    """A run before it begins.

    Attributes:
        info: The input.
        goal: What is asked.
        count: What that comes to, or None where it is not known beforehand.
        preset: Name of the preset.
        parameters: Of the method.
        encoding: What chunks take, for levels that may lie in them.
        measured: Whether results are held against the input on views held out.
        joined: The files of the input where it is several, parts of one scene.
        divided: Whether it is simplified in blocks.
    """

    info: FileInfo
    goal: Goal
    count: int | None
    preset: str
    parameters: Parameters
    encoding: "Encoding | None" = None
    measured: bool = False
    joined: tuple[Path, ...] = ()
    divided: bool = False

    @property
    def name(self) -> str:
        """Name the input."""
        return ", ".join(map(str, self.joined or (self.info.path,)))

    def _judged(self) -> bool:
        """Whether measuring counts: where the preset looks, that has taken as much before.

        Levels are measured one by one, and the views of the original are held all the time.
        """
        levels = self.encoding is not None
        more = self.measured and (levels or not renders(self.parameters))
        return more or self.goal.psnr is not None

    def memory(self) -> MemoryPlan:
        """The memory it takes; an unknown count takes that of the whole model."""
        info = self.info
        most = self.count or info.splats
        plan = plan_memory(
            info.splats, info.sh_degree, info.extra_bytes(), self.parameters, most,
            judged=self._judged(),
        )  # fmt: skip
        if not (self.encoding and self.encoding.each):
            return plan
        from nanogs.pipeline.encoding import PLACED

        # Between two levels, what a cut needs is kept, and each is encoded before the next.
        row = plan.input_columns // info.splats + PLACED
        held = int(plan.stages.get("cut", plan.input_columns) + most * row + self.encoding.file)
        return replace(plan, stages=plan.stages | {"encode": held}, peak=max(plan.peak, held))


def print_plan(plan: Plan) -> None:
    """Show on stderr what a run would do."""
    if plan.count is None and plan.goal.size is not None:
        text = f"as many splats as fit into {plan.goal.size:,} B, found by writing some"
    elif plan.count is None:
        text = f"as few splats as reach {plan.goal.psnr:g} dB on {Protocol().text}"
    else:
        text = f"{counted(plan.count, 'splat')} ({plan.count / plan.info.splats:.3%})"
    _print_rows(plan, text)


def print_wish(plan: Plan) -> None:
    """Show on stderr what a run would read and write, of a model that does not fit into memory."""
    print_divided(plan, counted(plan.count or 0, "splat"))


def print_divided(plan: Plan, text: str) -> None:
    """Show the plan of a model in blocks, with words for what would be written."""
    rows = _wish_rows(plan, text)
    whole = f"{bytes_text(plan.memory().peak)} if whole, and {_LIBRARIES}"
    show(err, key_value_table(rows | {"peak memory": whole}))


def plan_json(plan: Plan) -> dict[str, Any]:
    """Describe what a run would do, for JSON."""
    asked = {"asked_ratio": plan.goal.ratio, "asked_count": plan.count}
    asked |= {"asked_size": plan.goal.size, "asked_psnr": plan.goal.psnr}
    return describe_plan(plan, asked)


def show_plan(plan: Plan, asked: dict[str, Any], text: str, *, json: bool) -> None:
    """Show a plan, for one result or for several.

    Args:
        plan: What a run is going to do.
        asked: What was asked, for JSON.
        text: What would be written, for people.
        json: On stdout as JSON, else on stderr for people.
    """
    if json:
        print_json(describe_plan(plan, asked))
    else:
        _print_rows(plan, text)


def describe_plan(plan: Plan, asked: dict[str, Any]) -> dict[str, Any]:
    """Describe what a run would do and what is asked of it, for JSON."""
    return {
        "input": plan.name,
        "input_count": plan.info.splats,
        **asked,
        "preset": plan.preset,
        "parameters": asdict(plan.parameters),
        "memory_bytes": asdict(plan.memory()),
    }


def _print_rows(plan: Plan, text: str) -> None:
    show(err, key_value_table(_wish_rows(plan, text) | _memory_rows(plan.memory())))


def _wish_rows(plan: Plan, text: str) -> dict[str, str]:
    info = plan.info
    parameters = effective(plan.parameters)
    return {
        "would read": f"{plan.name} ({counted(info.splats, 'splat')}, SH degree {info.sh_degree})",
        "would write": text,
        "preset": plan.preset,
        "parameters": ", ".join(f"{name} {value}" for name, value in parameters.items()),
    }


def _memory_rows(memory: MemoryPlan) -> dict[str, str]:
    """The peak, and what each stage holds, the model with it."""
    rows = {"peak memory": f"about {bytes_text(memory.peak)}, and {_LIBRARIES}"}
    return rows | {f"  {stage}": bytes_text(held) for stage, held in memory.stages.items()}


def stop_text(run: dict[str, Any]) -> str:
    """Why a result is not what was asked for, in one sentence."""
    if run["stop"] == StopReason.UNREACHED:
        return (
            f"99 % of the splats do not reach {run['asked_psnr']:g} dB{_nearest_text(run)}, so the"
            f" whole model was written: {run['stop']}."
        )
    if run["stop"] == StopReason.PROBES:
        return (
            f"The search for the fewest splats ended after {len(run['probes'])} counts; what was "
            f"written reaches {run['asked_psnr']:g} dB, and fewer may too: {run['stop']}."
        )
    return f"Stopped before the asked count: {run['stop']}."


def _nearest_text(run: dict[str, Any]) -> str:
    """The PSNR of the largest count that was tried, in words."""
    if not run["probes"]:
        return ""
    most = max(run["probes"], key=itemgetter("count"))
    of = counted(run["input_count"], "splat has", "splats have")
    return f" ({most['count']:,} of {of} {most['psnr']:.2f} dB)"


def warn_of_input(run: dict[str, Any]) -> None:
    """Pass on the notes, and say what was left out."""
    for note in run["notes"]:
        warn(note)
    if run["dropped_nonfinite"]:
        dropped = counted(run["dropped_nonfinite"], "splat holds", "splats hold")
        left = "was" if run["dropped_nonfinite"] == 1 else "were"
        warn(f"{dropped} a NaN or infinite value and {left} left out.")


def print_report(run: dict[str, Any], *, verbose: bool) -> None:
    """Show on stderr what was delivered, in a line; with `verbose` all that is known of it."""
    report_filters(run)
    warn_of_input(run)
    if run["prune_limited"]:
        warn("Pruning alone would have gone below the asked count; the most opaque were kept.")
    if verbose:
        _print_details(run)
    say(summary(run))


def summary(run: dict[str, Any]) -> str:
    """Sum up: "500,000 → 50,000 splats in b.ply, 76.0 → 1.2 MB, 6 s", with the PSNR if known."""
    to = arrow()
    parts = [
        f"{run['read_count']:,} {to} {counted(run['achieved_count'], 'splat')} in {run['output']}",
        sizes_text(run["input_bytes"], run["output_bytes"], to) + _formats_text(run, to),
        _judged_text(run),
        time_text(run["total_seconds"]),
    ]
    return ", ".join(part for part in parts if part)


def _formats_text(run: dict[str, Any], to: str) -> str:
    """Why fewer splats may take more bytes: such as " (.sog → .ply)"."""
    if run["output_bytes"] <= run["input_bytes"]:
        return ""
    known = [registry.find(Path(run[end])) for end in ("input", "output")]
    names = [each.suffix for each in known if each]
    return f" ({names[0]} {to} {names[1]})" if len(set(names)) == 2 else ""


def _print_details(run: dict[str, Any]) -> None:
    """Show what was asked, how it was done, and where the time went."""
    before, after = run["input_count"], run["achieved_count"]
    filtered = " that the filters left" if run["filters"] else ""
    stages = ", ".join(f"{name} {value:.2f}" for name, value in run["seconds"].items())
    read, made = counted(run["read_count"], "splat"), counted(after, "splat")
    rows = {
        "input": f"{run['input']}: {read}, {bytes_text(run['input_bytes'])}",
        "output": f"{run['output']}: {made}, {bytes_text(run['output_bytes'])}",
        "kept": f"{after / before:.3%} of the splats{filtered} (asked: {_asked_text(run)})",
        "passes": f"{len(run['passes'])}, stopped by: {run['stop']}" if run["passes"] else "",
        "blocks": _blocks_text(run["blocks"]),
        "seen": f"{run['shown']:.0%} of the coverage is of splats that the views show"
        if run["shown"] is not None
        else "",
        "chosen": choice_text(run["candidates"]),
        "fitted": refit_text(run["refit"]),
        "probes": f"{counted(len(run['probes']), 'count')} tried" if run["probes"] else "",
        "size": _size_text(run),
        "time": f"{run['total_seconds']:.2f} s on {run['threads']} threads",
        "stages (s)": stages,
    }
    if run["pruned"]:
        rows["pruned"] = f"{run['pruned']:,} with alpha below {run['prune_threshold']:.3g}"
    show(err, key_value_table({name: text for name, text in rows.items() if text}))
    if run["passes"]:
        show(err, _pass_table(run["passes"]))
    if run["probes"]:
        show(err, _probe_table(run["probes"]))
    if run["size_probes"]:
        show(err, _size_probe_table(run["size_probes"]))


def _asked_text(run: dict[str, Any]) -> str:
    if run["asked_size"] is not None:
        return f"at most {run['asked_size']:,} B"
    if run["asked_psnr"] is not None:
        return f"{run['asked_psnr']:g} dB"
    return f"{run['asked_count']:,}"


def _judged_text(run: dict[str, Any]) -> str:
    """The numbers that `nanogs compare` gives the result, where they were measured."""
    if run["judged"] is None:
        return ""
    judged = run["judged"]
    return Judged(judged["psnr"], judged["ssim"], Protocol(**judged["protocol"])).text


def _size_text(run: dict[str, Any]) -> str:
    if run["achieved_size"] is None:
        return ""
    taken = run["achieved_size"] / run["asked_size"]
    tried = f"; {len(run['size_probes'])} counts written" if run["size_probes"] else ""
    return f"{run['achieved_size']:,} B, {taken:.1%} of what was asked for{tried}"


def _blocks_text(blocks: dict[str, Any] | None) -> str:
    """How a model was divided that was not held whole."""
    if blocks is None:
        return ""
    before = counted(blocks["resumed"], "task was", "tasks were")
    resumed = f"; {before} done before" if blocks["resumed"] else ""
    return f"{blocks['blocks']:,} of at most {counted(blocks['largest'], 'splat')}{resumed}"


def _lead_text(chosen: dict[str, Any], next_one: dict[str, Any]) -> str:
    lead = chosen["quality"] - next_one["quality"]
    if lead >= 0:
        return f" ({lead:+.2f} dB against the next)"
    return f" (growth {next_one['growth']:g} gains {-lead:.2f} dB, too little)"


def choice_text(candidates: list[dict[str, Any]]) -> str:
    """Say what was chosen by measurement, and its gain over the best of the others."""
    if not candidates:
        return ""
    chosen = next(entry for entry in candidates if entry["chosen"])
    others = [entry for entry in candidates if entry is not chosen]
    moved = ", reassigned" if chosen["reassigned"] else ""
    lead = _lead_text(chosen, max(others, key=itemgetter("quality"))) if others else ""
    what = f"balance {chosen['balance']:g}{moved}, growth {chosen['growth']:g}"
    shown = f"{chosen['psnr']:.2f} dB, SSIM {chosen['ssim']:.3f} on the views it was chosen by"
    return f"{what} of {len(candidates)} tried{lead}: {shown}"


def refit_text(refit: dict[str, Any] | None) -> str:
    """Say what fitting gained on the views that decide, and why it ended."""
    if refit is None:
        return ""
    before, after = refit["psnr_before"], refit["psnr_after"]
    return f"{before:.2f} to {after:.2f} dB on the views that decide, stopped by: {refit['stop']}"


def _pass_table(passes: list[dict[str, Any]]) -> Table:
    table = Table("splats", "candidates", "merged", "left", "highest cost", "seconds")
    for entry in passes:
        highest = entry["highest_cost"]
        table.add_row(
            f"{entry['count_before']:,}",
            f"{entry['candidates']:,}",
            f"{entry['merged']:,}",
            f"{entry['count_after']:,}",
            "-" if highest is None else f"{highest:.4g}",
            f"{sum(entry['seconds'].values()):.2f}",
        )
    return table


def _probe_table(probes: list[dict[str, Any]]) -> Table:
    table = Table("splats", "PSNR", "", box=None, pad_edge=False)
    for entry in probes:
        made = "a plain cut, to come near" if entry["quick"] else "as delivered"
        table.add_row(f"{entry['count']:,}", number_text(entry["psnr"]), made)
    return table


def _size_probe_table(probes: list[dict[str, Any]]) -> Table:
    table = Table("splats", "bytes", box=None, pad_edge=False)
    for entry in probes:
        table.add_row(f"{entry['count']:,}", f"{entry['bytes']:,}")
    return table
