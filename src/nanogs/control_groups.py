"""The control groups of this process: folders with the limits that containers set on Linux."""

import math
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

PROC = Path("/proc")  # process information
GROUPS = Path("/sys/fs/cgroup")


def group_folders(
    controller: str, proc: Path = PROC, groups: Path = GROUPS
) -> Iterator[tuple[int, Path]]:
    """Iterate over the folders of this process's group and its ancestors, if there are any.

    A container may see its own group as the root.

    Args:
        controller: What is limited, such as `memory` or `cpu`.
        proc: Root of the system's process information.
        groups: Root of the control groups.

    Yields:
        The version of control groups, 1 or 2, and the folder, which may be missing.
    """
    for line in read_text(proc / "self" / "cgroup").splitlines():
        _number, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        names = controllers.split(",")
        inner = PurePosixPath(path.lstrip("/"))
        for each in (inner, *inner.parents):
            if controller in names:
                yield 1, groups / controller / each
            elif names == [""]:
                yield 2, groups / each


def processor_quota(proc: Path = PROC, groups: Path = GROUPS) -> int | None:
    """Return the processors whose time this process may use, rounded up; None without a limit.

    Args:
        proc: Root of the system's process information.
        groups: Root of the control groups.
    """
    shares = []
    for version, folder in group_folders("cpu", proc, groups):
        if version == 2:
            quota, period = [*read_text(folder / "cpu.max").split(), "", ""][:2]
        else:
            quota = read_text(folder / "cpu.cfs_quota_us").strip()  # -1 without a limit
            period = read_text(folder / "cpu.cfs_period_us").strip()
        if quota.isdigit() and period.isdigit() and int(period):
            shares.append(int(quota) / int(period))
    return max(1, math.ceil(min(shares))) if shares else None


def read_number(path: Path) -> int | None:
    """Read the number in a file; None if the file is missing or holds `max`."""
    text = read_text(path).strip()
    return int(text) if text.isdigit() else None


def read_text(path: Path) -> str:
    """Read a small system file; empty if there is none."""
    try:
        return path.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        return ""
