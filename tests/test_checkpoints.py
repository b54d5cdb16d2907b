"""Checkpoints of trainers, and malicious files that contain more than tensors."""

import dataclasses
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings

import nanogs
from builders import random_splats
from damage import mutate, outcome
from launch import run
from nanogs import io
from nanogs.errors import FormatError, OptionError
from nanogs.io.checkpoint import torch_file
from nanogs.io.registry import sniff
from strategies import assert_same, splats
from torchfiles import Raw, TorchFile, call, gsplat, name, nerfstudio, pickled, reference_trainer

SHARED = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=30
)
WRITERS = {"a.pt": gsplat, "a.ckpt": nerfstudio}


def write_checkpoint(path, content, **kwargs):
    path.write_bytes(TorchFile(content, **kwargs).bytes())
    return path


@SHARED
@given(model=splats(extras=False))
@pytest.mark.parametrize("file", WRITERS)
def test_checkpoints_of_trainers_are_read_exactly(tmp_path, model, file):
    model = dataclasses.replace(model, render_mode="default", comments=())
    if file == "a.ckpt" and model.sh_degree == 0:
        return  # its colours are stored in another way; another test covers them
    path = write_checkpoint(tmp_path / file, WRITERS[file](model))
    back = io.load(path)
    assert_same(dataclasses.replace(back, render_mode="default"), model)
    info = io.inspect(path)
    assert (info.splats, info.sh_degree) == (len(model), model.sh_degree)
    assert info.double_means == (model.means.dtype == np.float64)


@pytest.mark.parametrize("prefix", ["_model.", "module._model.gauss_params.", ""])
def test_prefixes_of_older_checkpoints_are_accepted(tmp_path, prefix):
    model = random_splats(9, degree=2)
    assert_same(io.load(write_checkpoint(tmp_path / "a.ckpt", nerfstudio(model, prefix))), model)


def test_nerfstudio_stores_colours_of_degree_0_as_logits(tmp_path):
    model = random_splats(9, degree=0)
    loaded = io.load(write_checkpoint(tmp_path / "a.ckpt", nerfstudio(model)))
    colours = 1 / (1 + np.exp(-model.sh.astype(np.float64)))
    assert loaded.sh == pytest.approx((colours - 0.5) / 0.28209479177387814, abs=1e-6)
    assert_same(io.load(write_checkpoint(tmp_path / "a.pt", gsplat(model))), model)


def test_tensors_of_other_layouts_types_and_byte_orders_are_read(tmp_path):
    """A transposed view, a view into a larger storage, other types, and the other byte order."""
    model = random_splats(8, degree=1)
    content = gsplat(model)
    parts = content["splats"]
    parts["means"] = np.asfortranarray(model.means).T.copy().T
    wide = np.zeros((10, 4), np.float32)
    wide[2:] = model.quats
    parts["quats"] = wide[2:]
    parts["opacities"] = model.opacity_logits.astype(np.float64)
    for order in ("little", "big"):
        assert_same(io.load(write_checkpoint(tmp_path / "a.pt", content, order=order)), model)
    assert_same(io.load(write_checkpoint(tmp_path / "a.pt", content, order_file=False)), model)
    parts["scales"] = model.log_scales.astype(np.float16)
    half = io.load(write_checkpoint(tmp_path / "a.pt", content))
    assert np.array_equal(half.log_scales, parts["scales"].astype(np.float32))


def test_bfloat16_tensors_are_read(tmp_path):
    model = random_splats(8, degree=0)
    content = gsplat(model)
    top = (model.log_scales.view(np.uint32) >> 16).astype(np.uint16)
    content["splats"]["scales"] = top
    loaded = io.load(write_checkpoint(tmp_path / "a.pt", content))
    assert np.array_equal(loaded.log_scales.view(np.uint32), top.astype(np.uint32) << 16)


def test_files_of_other_ranks_are_named_in_the_notes(tmp_path):
    model = random_splats(5)
    for rank in range(3):
        write_checkpoint(tmp_path / f"ckpt_29999_rank{rank}.pt", gsplat(model))
    write_checkpoint(tmp_path / "ckpt_6999_rank1.pt", gsplat(model))
    notes = io.load(tmp_path / "ckpt_29999_rank0.pt").notes
    assert notes == (
        "The splats of other devices are in other files: ckpt_29999_rank1.pt, ckpt_29999_rank2.pt.",
    )
    assert io.load(tmp_path / "ckpt_6999_rank1.pt").notes == ()


@pytest.mark.parametrize("ways", [{}, {"block": 30}])
@pytest.mark.parametrize("left", [0, 7])
def test_a_note_on_joined_ranks_names_those_that_are_not_among_them(tmp_path, left, ways):
    names = [f"ckpt_29999_rank{rank}.pt" for rank in range(2 + left)]
    for file in names:
        write_checkpoint(tmp_path / file, gsplat(random_splats(30, degree=0)))
    parts = [tmp_path / name for name in names[:2]]
    out = tmp_path / "small.ply"
    report = nanogs.simplify_blocks(parts, out, count=9, preset="fast", **ways)
    assert (report.input_count, report.blocks is not None) == (60, bool(ways))
    said = [note for note in report.notes if "devices" in note]
    missing = ", ".join(names[2:8])  # at most six are named
    text = f"The splats of other devices are in other files: {missing}."
    assert said == [text] * bool(left)


# Malicious and damaged files


def test_tensors_of_the_splats_that_are_left_out_are_named(tmp_path):
    model = random_splats(9, degree=1)
    content = gsplat(model)
    content["splats"] |= {"labels": np.zeros((9, 2), "f4"), "ages": np.zeros(9, "i8")}
    content["splats"] |= {"background": np.zeros(3, "f4"), "step": np.zeros((), "i8")}
    loaded = io.load(write_checkpoint(tmp_path / "a.pt", content))
    assert loaded.notes == ("Left out of the checkpoint: labels, ages.",)
    assert_same(dataclasses.replace(loaded, notes=()), model)


def exploit(*code):
    """Return a file whose data runs `code` when it is loaded with Python's pickle."""
    return TorchFile({"means": Raw(b"".join(code))})


EXPLOITS = {
    "os.system": exploit(call(name("os", "system"), "touch pwned")),
    "posix.system": exploit(call(name("posix", "system"), "touch pwned")),
    "eval": exploit(call(name("builtins", "eval"), "open('pwned', 'w')")),
    "getattr": exploit(call(name("builtins", "getattr"), name("os", "system"))),
    "torch.load": exploit(call(name("torch", "load"), "a.pt")),
    "torch.hub": exploit(call(name("torch.hub", "load"), "a", "b")),
    "numpy.load": exploit(call(name("numpy", "load"), "a.npy")),
    "inst": exploit(b"(X\x0b\x00\x00\x00touch pwnedios\nsystem\n"),
    "stack_global": exploit(pickled("os"), pickled("system"), b"\x93"),
    "dotted": exploit(pickled("collections"), pickled("OrderedDict.__init__"), b"\x93"),
    "ours": exploit(call(name("nanogs.io.checkpoint.torch_file", "TorchFile"), "a.pt")),
}


@pytest.mark.parametrize("kind", EXPLOITS)
def test_code_in_a_file_is_refused_and_not_run(tmp_path, kind, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.pt").write_bytes(EXPLOITS[kind].bytes())
    for use in (io.load, io.inspect):
        with pytest.raises(FormatError, match="could run code") as caught:
            use("a.pt")
        assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["a.pt"]


HARMLESS = {
    # Attributes of the allowed classes and functions cannot be set: this would change later loads.
    "state_of_the_maker": exploit(
        name("torch._utils", "_rebuild_tensor_v2"), pickled((None, {"__code__": 1})), b"b"
    ),
    "state_of_a_class": exploit(
        name("collections", "OrderedDict"), pickled((None, {"update": 1})), b"b"
    ),
    "a_huge_place": exploit(b"N", b"r\xff\xff\xff\xff"),
    "unknown_extension": exploit(b"\x82\x01"),
    "no_storage": exploit(call(name("torch._utils", "_rebuild_tensor_v2"), 1, 0, (), ())),
    "endless": TorchFile({"means": Raw(b"}" + b"q\x00X\x01\x00\x00\x00ah\x00s")}),
    "nested": exploit(b"]" * 100_000),
    "truncated": exploit(b"X\xff\xff\xff\x7f"),
}


@pytest.mark.parametrize("kind", HARMLESS)
def test_odd_pickles_are_refused_and_do_not_affect_later_files(tmp_path, kind):
    (tmp_path / "a.pt").write_bytes(HARMLESS[kind].bytes())
    with pytest.raises(FormatError):
        io.load(tmp_path / "a.pt")
    model = random_splats(3)
    assert_same(io.load(write_checkpoint(tmp_path / "b.pt", gsplat(model))), model)


def tensor_of(shape, steps, offset=0, count=12):
    identity = ("storage", name("torch", "FloatStorage"), "0", "cpu", count)
    return call(
        name("torch._utils", "_rebuild_tensor_v2"),
        Raw(pickled(identity) + b"Q"),
        offset, shape, steps, False, None,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("shape", "steps", "offset", "count"),
    [
        ((4, 3), (3, 1), 1, 12),  # reaches one number beyond the end
        ((5, 3), (3, 1), 0, 12),
        ((4, 3), (4, 1), 0, 12),
        ((1 << 40, 3), (0, 0), 0, 12),  # one number repeated
        ((4, 3), (-3, 1), 9, 12),
        ((4, 3), (3, 1), 0, 1 << 40),  # more numbers than the file holds
        ((4, "3"), (3, 1), 0, 12),
    ],
)
def test_tensors_that_do_not_fit_their_storage_are_refused(tmp_path, shape, steps, offset, count):
    content = gsplat(random_splats(4, degree=0))
    content["splats"]["means"] = tensor_of(shape, steps, offset, count)
    file = TorchFile(content)
    file.storages[0] = np.zeros(12, np.float32).tobytes()
    (tmp_path / "a.pt").write_bytes(file.bytes())
    with pytest.raises(FormatError):
        io.load(tmp_path / "a.pt")
    with pytest.raises(FormatError):  # before memory is allocated for the tensor
        io.inspect(tmp_path / "a.pt")


@pytest.mark.parametrize(
    ("shape", "steps"), [((0, 1 << 62), (1, 1)), ((1, 1), (1 << 62, 1)), ((0, 1 << 64), (1, 1))]
)
@pytest.mark.parametrize("legacy", [False, True])
def test_tensors_of_sizes_beyond_any_array_are_refused(tmp_path, shape, steps, legacy):
    file = TorchFile(gsplat(random_splats(4, degree=0)), legacy=legacy)
    (tmp_path / "a.pt").write_bytes(file.bytes())
    read = torch_file.TorchFile(tmp_path / "a.pt")
    tensor = read.content["splats"]["means"]
    assert read.array(tensor).shape == (4, 3)
    with pytest.raises(FormatError, match="is damaged or no file of torch"):
        read.array(tensor._replace(shape=shape, strides=steps))


@pytest.mark.filterwarnings("error")
def test_doubles_beyond_single_precision_are_counted_in_a_note(tmp_path):
    content = gsplat(random_splats(4, degree=0))
    content["splats"]["scales"] = content["splats"]["scales"].astype(np.float64)
    content["splats"]["scales"][1, :2] = 1e300, np.inf
    model = io.load(write_checkpoint(tmp_path / "a.pt", content))
    assert np.isinf(model.log_scales).sum() == 2
    assert model.notes == ("1 value of 'scales' became infinite when converted to float32.",)


def test_two_scales_are_those_of_flat_splats(tmp_path):
    model = random_splats(6)
    captured = reference_trainer(model)[0]
    content = (*captured[:4], model.log_scales[:, :2], *captured[5:])
    again = io.load(write_checkpoint(tmp_path / "a.pth", content))
    assert again.render_mode == "2dgs"
    assert np.array_equal(again.log_scales[:, :2], model.log_scales[:, :2])
    assert (again.log_scales[:, 2] == -np.inf).all()
    assert "two scales" in " ".join(again.notes)
    info = io.inspect(tmp_path / "a.pth")
    assert (info.render_mode, info.render_tag) == ("2dgs", "its two scales per splat")


def test_checkpoints_without_usable_splats_are_refused_with_the_reason(tmp_path):
    model = random_splats(4)
    cases = {
        "no splats": {"weights": np.ones(3, np.float32)},
        "its tensors: none": [1, 2],
        r"its tensors: 0, 1\.0": (np.ones(3, np.float32), [np.ones(2, np.float32)]),
        "network": {"splats": {"means": model.means, "features": model.means}},
        "2 models": {"a": gsplat(model)["splats"], "b": gsplat(model)["splats"]},
        "not floats": {"splats": gsplat(model)["splats"] | {"means": np.ones((4, 3), np.int64)}},
        "must be": {"splats": gsplat(model)["splats"] | {"quats": model.means}},
        "Save the splats again": {"splats": gsplat(model)["splats"] | {"sh0": model.means[:2]}},
    }
    for words, content in cases.items():
        path = write_checkpoint(tmp_path / "a.pt", content)
        with pytest.raises(FormatError, match=words):
            io.load(path)
    (tmp_path / "a.pt").write_bytes(b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.")
    with pytest.raises(FormatError, match="is damaged"):
        io.load(tmp_path / "a.pt")
    (tmp_path / "a.pt").write_bytes(b"other")
    with pytest.raises(FormatError, match="neither like a zip file nor like an old file"):
        io.load(tmp_path / "a.pt")
    packed = write_checkpoint(tmp_path / "a.pt", gsplat(model), method=zipfile.ZIP_DEFLATED)
    with pytest.raises(FormatError, match="packed"):
        io.load(packed)
    with zipfile.ZipFile(tmp_path / "a.pt", "w") as archive:
        archive.writestr("x", "")
    with pytest.raises(FormatError, match=r"no data\.pkl"):
        io.load(tmp_path / "a.pt")
    with pytest.raises(OptionError, match="does not write"):
        io.save(model, tmp_path / "b.pt")


def test_damaged_files_give_a_format_error_or_a_model(tmp_path):
    seed, rng = TorchFile(nerfstudio(random_splats(3))).bytes(), np.random.default_rng(0)
    path = tmp_path / "a.ckpt"
    outcomes = {"model": 0, "refused": 0}
    for _ in range(400):
        path.write_bytes(mutate(rng, seed, header=1500, anywhere=0.3))
        outcomes[outcome(path)] += 1
    assert min(outcomes.values()) > 0


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("degree", [0, 3])
def test_checkpoints_of_the_reference_trainer_are_read(tmp_path, degree, legacy):
    model = random_splats(30, degree=degree)
    path = write_checkpoint(tmp_path / "chkpnt30000.pth", reference_trainer(model), legacy=legacy)
    assert_same(io.load(path), model)
    info = io.inspect(path)
    assert (info.splats, info.sh_degree) == (30, degree)
    assert info.encoding == ("binary_little_endian" if legacy else "zip")
    write_checkpoint(path, reference_trainer(model)[0], legacy=legacy)  # without the iteration
    assert_same(io.load(path), model)


# Before PyTorch 1.6


@pytest.mark.parametrize("order", ["little", "big"])
@pytest.mark.parametrize("content", [gsplat, nerfstudio])
def test_files_of_the_old_layout_are_read(tmp_path, content, order):
    model = random_splats(60, degree=2)
    path = write_checkpoint(tmp_path / "a.pt", content(model), legacy=True, order=order)
    assert_same(io.load(path), model)
    assert io.inspect(path).encoding == f"binary_{order}_endian"


@pytest.mark.parametrize("legacy", [False, True])
def test_code_is_refused_in_old_files_too(tmp_path, legacy):
    evil = {"splats": call(name("os", "system"), "touch /tmp/evil")}
    path = write_checkpoint(tmp_path / "a.pt", evil, legacy=legacy)
    with pytest.raises(FormatError, match=r"refers to os\.system, which tensors do not need"):
        io.load(path)


def test_every_truncation_of_an_old_file_is_refused(tmp_path):
    data = TorchFile(gsplat(random_splats(2, degree=0)), legacy=True).bytes()
    for size in range(1, len(data)):
        (tmp_path / "a.pt").write_bytes(data[:size])
        with pytest.raises(FormatError):
            io.load(tmp_path / "a.pt")


def test_an_old_file_with_wrong_storage_sizes_is_refused(tmp_path):
    file = TorchFile(gsplat(random_splats(4, degree=0)), legacy=True)
    for size in (-1, 11, 13, 2**40, 2**62):
        file.sizes[0] = size
        (tmp_path / "a.pt").write_bytes(file.bytes())
        with pytest.raises(FormatError):
            io.load(tmp_path / "a.pt")


def test_the_format_of_an_old_file_is_detected_from_its_content(tmp_path):
    path = write_checkpoint(tmp_path / "a.pt", gsplat(random_splats(9)), legacy=True)
    assert sniff(path) == ".pt"


# The command, and files that PyTorch wrote


def test_the_command_converts_checkpoints_from_files_and_pipes(tmp_path):
    model = random_splats(40)
    path = write_checkpoint(tmp_path / "a.ckpt", nerfstudio(model))
    assert run("convert", path, tmp_path / "a.ply").returncode == 0
    assert_same(nanogs.load(tmp_path / "a.ply"), model)
    piped = run("convert", "-", "-", "--to", "ply", data=path.read_bytes(), text=False)
    assert piped.stdout == (tmp_path / "a.ply").read_bytes()


def test_files_written_by_pytorch_are_read(tmp_path):
    torch = pytest.importorskip("torch")
    model = random_splats(50, degree=3)
    content = gsplat(model)
    splats = {name: torch.from_numpy(array) for name, array in content["splats"].items()}
    parameters = torch.nn.ParameterDict(splats)
    optimiser = torch.optim.Adam(parameters.values())
    sum(value.sum() for value in parameters.values()).backward()
    optimiser.step()
    moved = {name: value.detach().numpy() for name, value in parameters.items()}
    expected = dataclasses.replace(
        model, means=moved["means"], log_scales=moved["scales"], quats=moved["quats"],
        opacity_logits=moved["opacities"], sh=np.concatenate([moved["sh0"], moved["shN"]], axis=1),
    )  # fmt: skip
    saved = {
        "step": 1,
        "splats": parameters.state_dict(),
        "optimizers": {"means": optimiser.state_dict()},
        "schedulers": {"means": {"last": np.float64(0.5)}},
        "shape": torch.Size([3]), "device": torch.device("cpu"), "type": torch.float32,
    }  # fmt: skip
    torch.save(saved, tmp_path / "a.pt")
    assert_same(io.load(tmp_path / "a.pt"), expected)
    torch.save({"splats": dict(parameters.items())}, tmp_path / "b.pt")
    assert_same(io.load(tmp_path / "b.pt"), expected)
    halves = {name: tensor.to(torch.bfloat16) for name, tensor in splats.items()}
    torch.save({"splats": halves}, tmp_path / "c.pt")
    assert np.array_equal(
        io.load(tmp_path / "c.pt").quats, halves["quats"].to(torch.float32).numpy()
    )
    torch.save({"splats": parameters.state_dict()}, tmp_path / "d.pt",
               _use_new_zipfile_serialization=False)  # fmt: skip
    assert_same(io.load(tmp_path / "d.pt"), expected)
    names = ("means", "sh0", "shN", "scales", "quats", "opacities")
    captured_model = (
        3,
        *(parameters[name] for name in names),
        torch.zeros(50),
        optimiser.state_dict(),
    )
    for old in (False, True):
        torch.save((captured_model, 7), tmp_path / "c.pth", _use_new_zipfile_serialization=not old)
        assert_same(io.load(tmp_path / "c.pth"), expected)
    torch.save(parameters, tmp_path / "e.pt")  # a module, whose class the pickle has to name
    with pytest.raises(FormatError, match="save only the state dictionary"):
        io.load(tmp_path / "e.pt")
