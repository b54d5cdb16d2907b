"""A writer of `.lcc2` models, whose parts are files that nanogs writes."""

import json

import nanogs
from builders import random_splats


def model(folder, rng, kind=".sog", *, old=False, environment=4, degree=1):
    """Write a model of two levels; return the path of its JSON and the splats of each file.

    Two nodes of the finer level share a file, and a file of it comes after one of the coarser.

    Args:
        folder: A folder, which is made.
        rng: Random generator.
        kind: Format of the files.
        old: Whether the fields have their older names.
        environment: Number of splats of the sky, or 0.
        degree: SH degree.
    """
    counts = {"a/0": 30, "a/1": 12, "b/0": 9, **({"env": environment} if environment else {})}
    files = {name: folder / f"{name}{kind}" for name in counts}
    for name, count in counts.items():
        files[name].parent.mkdir(parents=True, exist_ok=True)
        splats = random_splats(count, degree=degree, seed=int(rng.integers(99)))
        nanogs.save(splats, files[name])
    path = folder / "meta.lcc2"
    found = description(list(counts), kind, old=old, environment=bool(environment))
    path.write_text(json.dumps(found))
    return path, [nanogs.load(file) for file in files.values()]


def node(index, count, below=None):
    """Make a node with splats of a file."""
    data = {"3dgs": {"name": index, "start": 0} | ({} if count is None else {"count": count})}
    return {"data": data, "childNum": len(below or []), "child": below}


def description(names, kind, *, old=False, environment=True):
    """Return the content of the JSON file of `model`."""
    fine = [node(0, 10), node(0, 20)]
    children = {"0": node(1, None, fine), "3": {"child": [node(2, 9)]}}
    files = [f"/{name}" if old else f"{name}{kind}" for name in names]
    data = {"env": {"name": 3}} if environment else {}
    root = {"data": data, "child": children, "files" if old else "splatFiles": files}
    if old:
        return {"total_splats": 51, "lod_3dgs_info": [12, 39], "lod_level": 2, "root": root}
    levels = {"totalSplats": 51, "lodSplats": [39, 12], "totalLevels": 2}
    return levels | {"splatType": kind, "root": root}
