"""Files of `.ksplat` built by hand, in every mode."""

import struct

import numpy as np

from builders import random_splats

C0 = 0.28209479177387814
CENTRE, NUMBER, COEFFICIENT = ("<f4", "<u2", "<u2"), ("<f4", "<f2", "<f2"), ("<f4", "<f2", "u1")
WIDTH, RANGE = 5.0, 32767


def section(n, mode, degree, *, capacity=4, seed=0, spare=0, **changes):
    """Make (header, body, model) of a section with full buckets, and partial ones of 1 to 3."""
    rng = np.random.default_rng(seed)
    full, lengths = divmod(n, capacity)[0] if mode else 0, []
    left = n - full * capacity if mode else 0
    while left:
        lengths.append(min(left, int(rng.integers(1, 4))))
        left -= lengths[-1]
    sizes = [capacity] * full + lengths
    centres = rng.integers(-9, 9, (len(sizes), 3)) * WIDTH
    model = random_splats(n, degree=degree, seed=seed)
    stored = centres.repeat(sizes, axis=0) if mode else 0
    model.means[:] = rng.uniform(-0.5, 0.5, (n, 3)) * WIDTH + stored
    rest = model.sh[:, 1:]
    bands = [
        rest[:, d * d - 1 : (d + 1) ** 2 - 1].transpose(0, 2, 1).reshape(n, 6 * d + 3)
        for d in range(1, degree + 1)
    ]
    columns = [model.means, np.exp(model.log_scales), model.unit_quats()]
    columns.append(np.column_stack([model.sh[:, 0] * C0 + 0.5, model.opacities()]) * 255)
    columns += [np.concatenate(bands, axis=1)] if degree else []
    if mode:
        columns[0] = np.rint((model.means - stored) * (RANGE / (WIDTH / 2))) + RANGE
    columns[3] = columns[3].clip(0, 255).round()
    if mode == 2 and degree:
        columns[4] = ((columns[4] + 2) / 4 * 255).clip(0, 255).round()
    kinds = [CENTRE[mode], NUMBER[mode], NUMBER[mode], "u1", COEFFICIENT[mode]]
    table = np.zeros(n + spare, [
        (f"c{i}", kind, column.shape[1])
        for i, (kind, column) in enumerate(zip(kinds, columns, strict=False))
    ])  # fmt: skip
    for i, column in enumerate(columns):
        table[f"c{i}"][:n] = column
    fields = {
        0: n, 4: n + spare, 8: capacity if mode else 0, 12: len(sizes), 24: RANGE if mode else 0,
        32: full, 36: len(lengths),
    }  # fmt: skip
    header = bytearray(1024)
    for offset, value in fields.items():
        struct.pack_into("<I", header, offset, value)
    struct.pack_into("<f", header, 16, WIDTH)
    struct.pack_into("<H", header, 20, 12 if mode else 0)
    struct.pack_into("<H", header, 40, degree)
    for offset, (kind, value) in changes.get("changes", {}).items():
        struct.pack_into(kind, header, offset, value)
    body = np.array(lengths, "<u4").tobytes() + centres.astype("<f4").tobytes() + table.tobytes()
    return bytes(header), body, model


def ksplat(*sections, mode=0, version=(0, 1), count=None, sh_range=(-2.0, 2.0)):
    total = sum(len(model) for _, _, model in sections) if count is None else count
    header = bytearray(4096)
    struct.pack_into("<BBHIIIIH", header, 0, *version, 0, len(sections), len(sections), total,
                     total, mode)  # fmt: skip
    struct.pack_into("<2f", header, 36, *sh_range)
    headers, bodies, _ = zip(*sections, strict=True) if sections else ((), (), ())
    return bytes(header) + b"".join(headers) + b"".join(bodies)
