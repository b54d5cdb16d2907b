r"""Measure our methods and splat-transform on real scenes, and print the tables of docs/results.md.

    python benchmarks/quality.py                                        # all of it, hours
    python benchmarks/quality.py --scenes plant,biker --ratios 0.1 \
        --methods default,rival --kinds 512,1600,roam                   # some minutes
    python benchmarks/quality.py --ablations --kinds 512,1600,roam
    python benchmarks/quality.py --scenes outdoors,meadow --kinds 512,1600,roam    # of unbounded.py

A method is one of ours (a preset, one with parameters such as default:k=12, a baseline); `rival`,
both modes of splat-transform 3.7.0 on the CPU; or `nanogs-ref`, files that were made beforehand for
some of the scenes. A kind of views is a number, the pixels of automatic views; `roam` or `inside`,
short for roam@512 and inside@512; or `photographs`, for scenes that have some.

Results and measurements are cached in --cache, by default the environment's NANOGS_BENCHMARKS or
~/.cache/nanogs-benchmarks: an interrupted run can be continued, and only what a change of the
sources affects is measured again. The cache key of our results has a hash of the sources, and that
of a measurement also one of its views, or of its photographs, and one of the sources that render
and score, so that all methods are measured in one way. Node 22 and splat-transform are installed
there by npm; splat-transform converts each scene to .ply, so that all tools start from the same
file.

The folder of the scenes is --folder or the environment's NANOGS_SCENES; by default it is
../shared/scenes beside the repository. Files made beforehand are in `peers` beside it.
"""

import argparse
import json
import sys
from pathlib import Path

from leads import report
from measurements import KINDS, PEERS, SCENES, Bench, Key
from nanogs.bench.methods import ABLATIONS, all_methods
from nanogs.defaults import BENCH_RATIOS
from rivals import BUILD, REAL_SCENES, RIVALS, install


def main() -> None:
    """Measure what is missing, and print the tables."""
    options = arguments()
    install()
    bench = Bench(options.folder, options.peers, options.cache)
    methods = chosen_methods(options)
    requested = [
        Key(scene, ratio, method, kind)
        for scene in options.scenes.split(",")
        for ratio in map(float, options.ratios.split(","))
        for method in methods
        for kind in options.kinds.split(",")
    ]
    if absent := dict.fromkeys(bench.peer(key).name for key in requested if bench.lacks(key)):
        print(f"Left out, not in {options.peers}: {', '.join(absent)}", file=sys.stderr)
    keys = [key for key in requested if bench.offers(key)]
    rows = bench.measure(keys, lambda text: print(text, file=sys.stderr, flush=True))
    if options.rows:
        options.rows.write_text("".join(json.dumps(row) + "\n" for row in rows))
    print(report(rows))


def chosen_methods(options: argparse.Namespace) -> list[str]:
    """Return the names of the methods, with `rival` replaced by its two modes."""
    if options.methods:
        names = options.methods.split(",")
    elif options.ablations:
        names = list(ABLATIONS)
    else:
        names = [*all_methods(), "rival", *PEERS]
    return [one for name in names for one in (RIVALS if name == "rival" else [name])]


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", default=",".join(SCENES), help="names of scenes")
    parser.add_argument("--ratios", default=",".join(map(str, BENCH_RATIOS)))
    parser.add_argument("--methods", help="default: all, the other tool too")
    parser.add_argument("--ablations", action="store_true", help="in place of all methods")
    parser.add_argument("--kinds", default=",".join(KINDS), help="of views")
    parser.add_argument("--folder", type=Path, default=REAL_SCENES, help="of the scenes")
    parser.add_argument("--peers", type=Path, help="default: peers beside the scenes")
    parser.add_argument("--cache", type=Path, default=BUILD)
    parser.add_argument("--rows", type=Path, help="also write the rows into this file")
    options = parser.parse_args()
    options.peers = options.peers or options.folder.parent / "peers"
    return options


if __name__ == "__main__":
    main()
