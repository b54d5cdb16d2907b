"""How `nanogs simplify` shows its plan and its report."""

from dataclasses import asdict
from typing import Any

from rich.table import Table

from nanogs.cli.console import err, key_value_table, print_json, warn
from nanogs.formatting import bytes_text
from nanogs.io import FileInfo
from nanogs.simplify.memory import plan_memory
from nanogs.simplify.presets import Parameters


def print_plan(info: FileInfo, goal: int, preset: str, chosen: Parameters, *, json: bool) -> None:
    """Show what a run would do: on stdout as JSON, or on stderr for people."""
    memory = plan_memory(info.splats, info.sh_degree, info.extra_bytes(), chosen.k)
    parameters = asdict(chosen)
    if json:
        print_json(
            {
                "input": str(info.path),
                "input_count": info.splats,
                "asked_count": goal,
                "preset": preset,
                "parameters": parameters,
                "memory_bytes": asdict(memory),
            }
        )
        return
    rows = {
        "would read": f"{info.path} ({info.splats:,} splats, SH degree {info.sh_degree})",
        "would write": f"{goal:,} splats ({goal / info.splats:.3%})",
        "preset": preset,
        "parameters": ", ".join(f"{name} {value}" for name, value in parameters.items()),
        "peak memory": f"about {bytes_text(memory.peak)}, and 150 MB for Python and its libraries",
    }
    rows |= {f"  {stage}": bytes_text(held) for stage, held in memory.stages.items()}
    err.print(key_value_table(rows))


def print_report(run: dict[str, Any], *, verbose: bool) -> None:
    """Show on stderr what was asked, what was delivered, and where the time went."""
    for note in run["notes"]:
        warn(note)
    if run["dropped_nonfinite"]:
        warn(f"{run['dropped_nonfinite']:,} splats hold a NaN or infinite value and were left out.")
    if run["prune_limited"]:
        warn("Pruning alone would have gone below the asked count; the most opaque were kept.")
    before, after = run["input_count"], run["achieved_count"]
    stages = ", ".join(f"{name} {value:.2f}" for name, value in run["seconds"].items())
    rows = {
        "input": f"{run['input']}: {before:,} splats, {bytes_text(run['input_bytes'])}",
        "output": f"{run['output']}: {after:,} splats, {bytes_text(run['output_bytes'])}",
        "kept": f"{after / before:.3%} of the splats (asked: {run['asked_count']:,})",
        "passes": f"{len(run['passes'])}, stopped by: {run['stop']}",
        "chosen": _choice_text(run["candidates"]),
        "refit": _refit_text(run["refit"]),
        "time": f"{run['total_seconds']:.2f} s on {run['threads']} threads",
        "stages (s)": stages,
    }
    if run["pruned"]:
        rows["pruned"] = f"{run['pruned']:,} with alpha below {run['prune_threshold']:.3g}"
    err.print(key_value_table({name: text for name, text in rows.items() if text}))
    if verbose:
        err.print(_pass_table(run["passes"]))


def _choice_text(candidates: list[dict[str, Any]]) -> str:
    """What was chosen by measurement, and by how much over the next."""
    if not candidates:
        return ""
    first, *others = sorted(candidates, key=lambda entry: -entry["quality"])
    moved = ", reassigned" if first["reassigned"] else ""
    lead = f" ({first['quality'] - others[0]['quality']:+.2f} dB over the next)" if others else ""
    shown = f"{first['psnr']:.2f} dB, SSIM {first['ssim']:.3f} on the views it was chosen by"
    return f"balance {first['balance']:g}{moved} of {len(candidates)} tried{lead}: {shown}"


def _refit_text(refit: dict[str, Any] | None) -> str:
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
