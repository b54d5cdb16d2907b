"""Files as torch.save writes them, made without PyTorch."""

import io
import struct
import zipfile

import numpy as np

KINDS = {"f4": "Float", "f8": "Double", "f2": "Half", "i8": "Long", "u1": "Byte", "u2": "BFloat16"}


class Raw(bytes):
    """Pickle opcodes that leave one object on the stack."""


def name(module, attribute):
    return Raw(f"c{module}\n{attribute}\n".encode())


def call(function, *arguments):
    return Raw(function + pickled(tuple(arguments)) + b"R")


class TorchFile:
    """A zip of a pickle and the storages of its arrays, or the file format before PyTorch 1.6."""

    def __init__(
        self, content, *, order="little", order_file=True, method=zipfile.ZIP_STORED, legacy=False
    ):
        self.legacy = legacy
        self.order, self.order_file, self.method = order, order_file, method
        self.storages, self.sizes = [], []
        self.pickle = b"\x80\x02" + pickled(content, self.tensor) + b"."

    def tensor(self, array):
        """Return the reference to an array; of a view, the array that it is a view of is stored."""
        base = array if array.base is None else array.base
        offset = (array.ctypes.data - base.ctypes.data) // array.itemsize
        self.storages.append(base.astype(base.dtype.newbyteorder(self.order[0].upper())).tobytes())
        storage = name("torch", f"{KINDS[array.dtype.str[1:]]}Storage")
        key = str(len(self.storages) - 1)
        view = (None,) if self.legacy else ()
        identity = pickled(("storage", storage, key, "cpu", base.size, *view))
        self.sizes.append(base.size)
        steps = tuple(step // array.itemsize for step in array.strides)
        rest = (offset, array.shape, steps, False, call(name("collections", "OrderedDict")))
        return call(name("torch._utils", "_rebuild_tensor_v2"), Raw(identity + b"Q"), *rest)

    def bytes(self):
        return self.legacy_bytes() if self.legacy else self.zip_bytes()

    def legacy_bytes(self):
        system_info = {"protocol_version": 1001, "little_endian": self.order == "little"}
        keys = [str(number) for number in range(len(self.storages))]
        out = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."
        for content in (1001, system_info):
            out += b"\x80\x02" + pickled(content) + b"."
        out += self.pickle + b"\x80\x02" + pickled(keys) + b"."
        for size, data in zip(self.sizes, self.storages, strict=True):
            out += struct.pack("<q", size) + data
        return out

    def zip_bytes(self):
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", self.method) as archive:
            archive.writestr("archive/data.pkl", self.pickle)
            if self.order_file:
                archive.writestr("archive/byteorder", self.order)
            for key, data in enumerate(self.storages):
                archive.writestr(f"archive/data/{key}", data)
            archive.writestr("archive/version", "3\n")
        return buffer.getvalue()


def pickled(value, tensor=None):
    """Return opcodes of pickle protocol 2; `tensor` encodes arrays."""

    def inner(entry):
        return pickled(entry, tensor)

    if isinstance(value, Raw):
        return value
    if value is None:
        return b"N"
    if isinstance(value, bool):
        return b"\x88" if value else b"\x89"
    if isinstance(value, int):
        return b"\x8a\x09" + value.to_bytes(9, "little", signed=True)
    if isinstance(value, float):
        return b"G" + struct.pack(">d", value)
    if isinstance(value, str):
        return b"X" + struct.pack("<I", len(value.encode())) + value.encode()
    if isinstance(value, tuple):
        return b"(" + b"".join(map(inner, value)) + b"t"
    if isinstance(value, list):
        return b"](" + b"".join(map(inner, value)) + b"e"
    if isinstance(value, dict):
        return b"}(" + b"".join(inner(k) + inner(v) for k, v in value.items()) + b"u"
    assert isinstance(value, np.ndarray), type(value)
    return tensor(value)


def gsplat(model):
    """A checkpoint of gsplat's trainer."""
    splats = {
        "means": model.means,
        "scales": model.log_scales,
        "quats": model.quats,
        "opacities": model.opacity_logits,
        "sh0": np.ascontiguousarray(model.sh[:, :1]),
        "shN": np.ascontiguousarray(model.sh[:, 1:]),
    }
    return {"step": 29_999, "splats": splats}


def reference_trainer(model):
    """A checkpoint of the reference trainer: what `capture` gives, and the iteration."""
    n = len(model)
    moments = {0: {"step": 9.0, "exp_avg": np.ones((n, 3), np.float32)}}
    optimiser = {"state": moments, "param_groups": [{"lr": 0.1, "name": "xyz", "params": [0]}]}
    return (
        (
            model.sh_degree,
            model.means,
            np.ascontiguousarray(model.sh[:, :1]),
            np.ascontiguousarray(model.sh[:, 1:]),
            model.log_scales,
            model.quats,
            model.opacity_logits[:, None],
            np.zeros(n, np.float32),
            np.zeros((n, 1), np.float32),
            np.zeros((n, 1), np.float32),
            optimiser,
            4.2,
        ),
        30_000,
    )


def nerfstudio(model, prefix="_model.gauss_params."):
    """A checkpoint of nerfstudio's trainer, optimisers and schedulers among it."""
    splats = {
        f"{prefix}means": model.means,
        f"{prefix}scales": model.log_scales,
        f"{prefix}quats": model.quats,
        f"{prefix}opacities": model.opacity_logits[:, None],
        f"{prefix}features_dc": np.ascontiguousarray(model.sh[:, 0]),
        f"{prefix}features_rest": np.ascontiguousarray(model.sh[:, 1:]),
    }
    moments = np.ones((len(model), 3), np.float32)
    scalar = call(name("numpy.core.multiarray", "scalar"), name("numpy", "dtype"), "8bytes..")
    return {
        "step": 29_999,
        "pipeline": {**splats, "_model.camera_optimizer.pose_adjustment": moments},
        "optimizers": {
            "means": {"state": {0: {"exp_avg": moments}}, "param_groups": [{"lr": 0.1}]}
        },
        "schedulers": {"means": {"last_epoch": 3, "_last_lr": [scalar]}},
        "scalers": {"scale": 65536.0},
    }
