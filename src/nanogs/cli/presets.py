"""`nanogs presets`."""

from dataclasses import asdict

from nanogs.cli import options
from nanogs.pipeline.options.presets import DEFAULT_PRESET, PRESETS, SUMMARIES, effective


def presets(json: options.Json = False) -> None:
    """List the presets of `simplify` and `lod`, and their parameters."""
    from nanogs.cli.console import key_value_table, out, print_json, show

    if json:
        print_json(
            {name: {"summary": SUMMARIES[name], **asdict(own)} for name, own in PRESETS.items()}
        )
        return
    rows = {}
    for name, own in PRESETS.items():
        values = effective(own)
        parameters = ", ".join(f"{key} {value}" for key, value in values.items())
        usual = " (used if none is named)" if name == DEFAULT_PRESET else ""
        rows[name] = f"{SUMMARIES[name]}{usual}\n{parameters}"
    show(out, key_value_table(rows))
