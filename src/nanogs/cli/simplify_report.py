"""How `nanogs simplify` shows its plan and its report."""

from dataclasses import asdict
from typing import Any

from rich.table import Table

from nanogs.cli.console import err, key_value_table, print_json, warn
from nanogs.formatting import bytes_text
from nanogs.io import FileInfo
from nanogs.simplify.memory import plan_memory
from nanogs.simplify.presets import PaperParameters


def print_plan(
    info: FileInfo, goal: int, preset: str, chosen: PaperParameters, *, json: bool
) -> None:
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
        "pruned": f"{run['pruned']:,} with alpha below {run['prune_threshold']:.3g}",
        "passes": f"{len(run['passes'])}, stopped by: {run['stop']}",
        "time": f"{run['total_seconds']:.2f} s on {run['threads']} threads",
        "stages (s)": stages,
    }
    err.print(key_value_table(rows))
    if verbose:
        err.print(_pass_table(run["passes"]))


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
