"""Each layout on a folder of two or three frames, with its traps."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

if sys.version_info < (3, 11):
    pytest.skip("depthrig.lab needs Python 3.11", allow_module_level=True)
h5py = pytest.importorskip("h5py", reason="h5py is not installed (the extra `lab`)")
pytest.importorskip("OpenEXR", reason="OpenEXR is not installed (the extra `lab`)")

from depthrig.lab import LabError
from depthrig.lab.config import DataConfig
from depthrig.lab.data import KINDS, hypersim, open_source
from depthrig.lab.sample import Licence, Sample, check_licences

from made import exr, sample, write

H, W = 24, 32


def open_(kind: str, root: Path, **options: Any) -> Any:
    return open_source(DataConfig(kind=kind, path=str(root), **options))


def depth(value: float = 1.0, height: int = H, width: int = W) -> np.ndarray:
    return np.full((height, width), value)


def color(height: int = H, width: int = W) -> np.ndarray:
    return np.random.default_rng(5).integers(0, 256, (height, width, 3), dtype=np.uint8)


def test_an_unknown_layout_and_a_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(LabError, match="unknown; use shards, depthrig"):
        open_("nyu", tmp_path)
    with pytest.raises(LabError, match="no such folder"):
        open_("shards", tmp_path / "none")
    for kind in KINDS:
        with pytest.raises(LabError, match=str(tmp_path)):
            open_(kind, tmp_path)


# HyperSim


def by_rays(distance: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Depth by the ray of each pixel."""
    height, width = distance.shape
    out = np.zeros((height, width))
    for y in range(height):
        for x in range(width):
            ray = camera @ [(x + 0.5) / width * 2 - 1, 1 - (y + 0.5) / height * 2, 1]
            out[y, x] = distance[y, x] * -ray[2] / np.sqrt(ray @ ray)
    return out


TAN = np.tan(np.pi / 6)
STANDARD = np.array([[TAN, 0, 0], [0, TAN * 0.75, 0], [0, 0, -1.0]])
TILTED = STANDARD + np.array([[0, 0, 0.1], [0, 0, 0], [0, 0.2, 0]])


def make_hypersim(root: Path, cameras: dict[str, np.ndarray]) -> None:
    rows = ["scene_name,camera_name,frame_id,included_in_public_release,exclude_reason,split_partition_name"]
    for scene in cameras:
        rows += [f"{scene},cam_00,{i},{i != 1},,train" for i in range(3)]
        rows.append(f"{scene},cam_00,3,True,,test")
    (root / hypersim.SPLITS).write_text("\n".join([*rows, "ai_999_999,cam_00,0,True,,train"]) + "\n")
    names = [f"M_cam_from_uv_{r}{c}" for r in range(3) for c in range(3)]
    lines = [",".join(["scene_name", *names])]
    lines += [",".join([scene, *(repr(float(v)) for v in m.ravel())]) for scene, m in cameras.items()]
    (root / hypersim.CAMERAS).write_text("\n".join(lines) + "\n")
    for n, scene in enumerate(cameras):
        for i in (0, 2, 3):
            folder = root / scene / "images"
            write(folder / "scene_cam_00_final_preview" / f"frame.{i:04d}.tonemap.jpg", color())
            path = folder / "scene_cam_00_geometry_hdf5" / f"frame.{i:04d}.depth_meters.hdf5"
            path.parent.mkdir(parents=True, exist_ok=True)
            distance = (2 + n + np.random.default_rng(i).random((H, W))).astype(np.float16)
            distance[0, 0] = np.nan
            with h5py.File(path, "w") as f:
                f["dataset"] = distance


def test_hypersim_has_distances_and_tilted_cameras(tmp_path: Path) -> None:
    make_hypersim(tmp_path, {"ai_001_001": STANDARD, "ai_001_002": TILTED})
    source = open_("hypersim", tmp_path)
    wanted = [f"ai_001_00{s}/cam_00/{i:04d}" for s in (1, 2) for i in (0, 2)]
    assert [source[i].name for i in range(len(source))] == wanted
    assert len(open_("hypersim", tmp_path, split="test")) == 2
    for index, camera in ((0, STANDARD), (2, TILTED)):
        got = source[index]
        distance = h5py.File(source._paths(index)[1])["dataset"][:].astype(np.float64)
        assert got.truth[0, 0] == 0
        np.testing.assert_allclose(got.truth.ravel()[1:], by_rays(distance, camera).ravel()[1:], rtol=1e-6)
        assert got.raw is None
    # As the formula of the standard camera has it: f = 886.81 at a width of 1024.
    f = 886.81 * W / 1024
    x, y = np.meshgrid(np.arange(W) + 0.5 - W / 2, np.arange(H) + 0.5 - H / 2)
    distance = h5py.File(source._paths(0)[1])["dataset"][:].astype(np.float64)
    np.testing.assert_allclose(source[0].truth[1:], (distance * f / np.sqrt(x**2 + y**2 + f**2))[1:], rtol=1e-5)
    assert source[0].intrinsics.fx == pytest.approx(f, rel=1e-5)
    assert (source[0].intrinsics.cx, source[0].intrinsics.cy) == (15.5, 11.5)
    assert source[2].intrinsics is None
    with pytest.raises(LabError, match="no intrinsics"):
        source[2].need_intrinsics("this")


def test_hypersim_without_its_tables_or_with_damage(tmp_path: Path) -> None:
    make_hypersim(tmp_path, {"ai_001_001": STANDARD})
    with pytest.raises(LabError, match='split = "all"'):
        open_("hypersim", tmp_path, split="all")
    text = (tmp_path / hypersim.CAMERAS).read_text()
    (tmp_path / hypersim.CAMERAS).write_text(text.splitlines()[0] + "\n")
    with pytest.raises(LabError, match="no camera of scene ai_001_001"):
        open_("hypersim", tmp_path)
    (tmp_path / hypersim.CAMERAS).unlink()
    with pytest.raises(LabError, match="apple/ml-hypersim"):
        open_("hypersim", tmp_path)
    (tmp_path / hypersim.CAMERAS).write_text(text)
    next(tmp_path.rglob("*.hdf5")).write_bytes(b"cut")
    with pytest.raises(LabError, match="hdf5"):
        [open_("hypersim", tmp_path)[i] for i in range(2)]


# DREDS, STD, HISS


def rgb(plane: np.ndarray) -> dict[str, np.ndarray]:
    return {"R": plane, "G": plane, "B": plane}


META = (
    "7 2 bottle 02876657_x 0.1 2 1 0 0 0 0 0 0\n9 1 can 02946921_y 0.1 3 1 0 0 0 0 0 0\n3 1 box z 0.1 0 1 0 0 0 0 0 0\n"
)


def make_stereo(folder: Path, number: str, truth_name: str, raw_name: str) -> None:
    write(folder / f"{number}_color.png", color(2 * H, 2 * W))
    raw = depth(1.01)
    raw[:4] = -0.001
    exr(folder / f"{number}_{truth_name}", **rgb(depth(1.0)))
    exr(folder / f"{number}_{raw_name}", **rgb(raw))


def mask() -> np.ndarray:
    out = np.full((H, W), 255)
    out[:, :8], out[:, 8:16], out[:, 16:20] = 7, 9, 3
    return out


def test_dreds_has_materials_and_negative_holes(tmp_path: Path) -> None:
    folder = tmp_path / "train" / "00001"
    for number in ("0000", "0001"):
        make_stereo(folder, number, "depth_120.exr", "simDepthImage.exr")
        exr(folder / f"{number}_mask.exr", **rgb(mask() / 255))
        (folder / f"{number}_meta.txt").write_text(META)
    source = open_("dreds", tmp_path)
    assert len(source) == 2
    got = source[1]
    assert got.name == "train/00001/0001"
    assert (got.raw[:4] == 0).all()
    np.testing.assert_allclose(got.raw[4:], 1.01, rtol=1e-6)
    assert got.material[0, [0, 8, 16, 20]].tolist() == [4, 3, 1, 0]
    assert got.intrinsics.fx == pytest.approx(446.31 / 20)
    want = color(2 * H, 2 * W).reshape(H, 2, W, 2, 3).astype(float).mean((1, 3))
    assert np.abs(got.color - want).max() <= 0.5
    assert not got.licence.ships
    (folder / "0000_meta.txt").write_text("7 2 bottle\n")
    with pytest.raises(LabError, match=r"0000_meta\.txt: line 1"):
        source[0]
    exr(folder / "0001_simDepthImage.exr", **rgb(depth(1, H // 2, W)))
    with pytest.raises(LabError, match="sizes are mixed"):
        source[1]
    write(folder / "0001_color.png", color(2 * H, 3 * W))
    exr(folder / "0001_simDepthImage.exr", **rgb(depth(1)))
    with pytest.raises(LabError, match="whole multiple"):
        source[1]
    (folder / "0001_depth_120.exr").write_bytes(b"v/1\x01 damaged")
    with pytest.raises(LabError, match=r"0001_depth_120\.exr: damaged"):
        source[1]
    (folder / "0001_depth_120.exr").unlink()
    with pytest.raises(LabError, match=r"0001_depth_120\.exr: no such file"):
        source[1]


def test_std_is_sorted_by_number_and_has_a_mask_of_bytes(tmp_path: Path) -> None:
    for n in (10, 2):
        folder = tmp_path / f"test_{n}"
        make_stereo(folder, "0000", "gt_depth.exr", "depth_415.exr")
        write(folder / "0000_mask.png", mask().astype(np.uint8))
        (folder / "0000_meta.txt").write_text(META)
    source = open_("std", tmp_path, split="test")
    assert [s.name for s in (source[0], source[1])] == ["test_2/0000", "test_10/0000"]
    assert source[0].material[0, [0, 8, 16, 20]].tolist() == [4, 3, 1, 0]


def test_hiss_leaves_out_what_its_authors_do(tmp_path: Path) -> None:
    for scene, surface in (("hssd_1", "table"), ("hssd_1", "glass_table"), ("hssd_2", "desk")):
        for number in ("0000", "0001"):
            make_stereo(tmp_path / "train" / scene / surface, number, "depth.exr", "simDepthImage.exr")
    (tmp_path / "bad_his.txt").write_text("hssd_2/desk/0001\n")
    source = open_("hiss", tmp_path)
    assert [source[i].name for i in range(len(source))] == [
        "train/hssd_1/table/0000",
        "train/hssd_1/table/0001",
        "train/hssd_2/desk/0000",
    ]


# IRS, HAMMER, ClearGrasp, TransCG


def test_irs_is_disparity_in_the_green_channel(tmp_path: Path) -> None:
    disparity = np.full((H, W), 24.0)
    disparity[0] = [-1, 0, np.nan, np.inf] * (W // 4)
    lines = []
    for i in (1, 2):
        write(tmp_path / "Home/a" / f"l_{i}.png", color())
        exr(tmp_path / "Home/a" / f"d_{i}.exr", G=disparity)
        lines.append(f"Home/a/l_{i}.png Home/a/r_{i}.png Home/a/d_{i}.exr Home/a/n_{i}.exr\n")
    (tmp_path / "lists").mkdir()
    (tmp_path / "lists/irs_train.list").write_text("".join(lines))
    (tmp_path / "lists/irs_test.list").write_text(lines[0])
    # Parts of the others, and one of another layout, as published.
    (tmp_path / "lists/home_test.list").write_text(lines[0])
    (tmp_path / "lists/irs_small_train.list").write_text(lines[0])
    (tmp_path / "lists/test.list").write_text(lines[0].replace("Home/", "IRSDataset/Home/"))
    source = open_("irs", tmp_path)
    assert len(source) == 2
    got = source[1]
    assert not got.truth[0].any()
    np.testing.assert_allclose(got.truth[1:], 2.0, rtol=1e-6)
    assert got.raw is None
    assert len(open_("irs", tmp_path, split="test")) == 1
    (tmp_path / "lists/irs_train.list").write_text("one two\n")
    with pytest.raises(LabError, match="line 1 is not LEFT RIGHT"):
        open_("irs", tmp_path)
    (tmp_path / "lists/irs_train.list").unlink()
    with pytest.raises(LabError, match="no lists/irs_train.list"):
        open_("irs", tmp_path)


def make_hammer(root: Path, scene: str, frames: int = 2, unit: float = 1000) -> Path:
    folder = root / scene / "polarization"
    for i in range(frames):
        write(folder / f"rgb/{i:06d}.png", color())
        for name, value in (("_gt", 0.8), ("depth_d435", 0.82), ("depth_l515", 0.81), ("depth_tof", 0.79)):
            plane = np.rint(depth(value) * unit).astype(np.uint16)
            plane[0] = 0
            write(folder / f"{name}/{i:06d}.png", plane)
    (folder / "intrinsics.txt").write_text("50 0 16\n0 51 12\n0 0 1\n")
    return folder


def test_hammer_splits_by_scene_and_chooses_a_sensor(tmp_path: Path) -> None:
    for scene in ("scene2_traj1_1", "scene12_traj1_1", "scene14_traj2_naked_1"):
        make_hammer(tmp_path, scene)
    train, test = open_("hammer", tmp_path, sensor="l515"), open_("hammer", tmp_path, sensor="tof", split="test")
    assert (len(train), len(test)) == (2, 4)
    assert train[1].raw[1, 1] == np.float32(0.81)
    assert train[1].truth[0, 0] == 0
    assert (train[1].intrinsics.fy, train[1].intrinsics.cx) == (51, 16)
    assert not train.licence.ships
    with pytest.raises(LabError, match="use d435, l515, tof"):
        open_("hammer", tmp_path)
    (tmp_path / "scene2_traj1_1/polarization/intrinsics.txt").write_text("1 2 3")
    with pytest.raises(LabError, match="3x3"):
        train[0]
    (tmp_path / "scene2_traj1_1/polarization/rgb/000000.png").unlink()
    with pytest.raises(LabError, match=r"000000\.png is missing"):
        open_("hammer", tmp_path, sensor="l515")


def test_cleargrasp_and_transcg(tmp_path: Path) -> None:
    folder = tmp_path / "a/real-test/d435"
    hole = depth(0.6)
    hole[0] = np.nan
    object_ = np.zeros((H, W), np.uint8)
    object_[:, 5] = 255
    write(folder / "3-transparent-rgb-img.jpg", color())
    exr(folder / "3-transparent-depth-img.exr", **rgb(hole))
    exr(folder / "3-opaque-depth-img.exr", **rgb(depth(0.58)))
    write(folder / "3-mask.png", object_)
    source = open_("cleargrasp", tmp_path / "a", sensor="d435", split="test")
    assert (source[0].name, source[0].raw[0, 0], source[0].material[0, 5]) == ("real-test/d435/3", 0, 4)
    with pytest.raises(LabError, match="use d415, d435"):
        open_("cleargrasp", tmp_path / "a", split="test")

    view = tmp_path / "b/scene1/0"
    for n, unit in ((1, 1000), (2, 4000)):
        write(view / f"rgb{n}.png", color())
        for name, value in (("depth", 0.7), ("gt", 0.72)):
            stem = f"depth{n}.png" if name == "depth" else f"depth{n}-gt.png"
            write(view / stem, np.rint(depth(value) * unit).astype(np.uint16))
        write(view / f"depth{n}-gt-mask.png", object_)
    for sensor in ("d435", "l515"):
        source = open_("transcg", tmp_path / "b", sensor=sensor, split="all")
        assert source[0].raw[0, 0] == np.float32(0.7)
        assert source[0].truth[0, 0] == np.float32(0.72)


# ByteCameraDepth


def make_bytes(folder: Path, value: float, unit: float, frames: int = 3) -> None:
    for n in range(frames):
        units = np.rint(depth(value) / unit).astype(np.uint16)
        units[0], units[1] = 0, 65535
        write(folder / f"depth_{n}.png", units)
        write(folder / f"color_{n}.png", np.dstack([color(), np.full((H, W), 255, np.uint8)]) if n else color())


def test_bytecameradepth_has_the_unit_of_each_model(tmp_path: Path) -> None:
    session = tmp_path / "20260314"
    make_bytes(session / "camera_realsense_405", 0.35, 1e-4)
    make_bytes(session / "camera_realsense_455", 1.5, 1e-3)
    make_bytes(session / "camera_realsense_l515", 0.9, 2.5e-4, frames=12)
    (session / "camera_realsense_455/color_1.png").unlink()
    for n in range(2):
        metres = depth(1.2).astype(np.float32)
        metres[0] = np.nan
        folder = session / "camera_zed2i_quality"
        folder.mkdir(exist_ok=True)
        np.save(folder / f"raw_depth_{n}.npy", metres)
        write(folder / f"color_{n}.png", color())
    source = open_("bytecameradepth", tmp_path)
    assert len(source) == 3 + 2 + 12 + 2
    for model, value in (("d405", 0.35), ("d455", 1.5), ("l515", 0.9), ("zed2i", 1.2)):
        of_model = open_("bytecameradepth", tmp_path, sensor=model)
        assert of_model.sensor == model
        got = of_model[len(of_model) - 1]
        assert not got.raw[0].any()
        assert model == "zed2i" or not got.raw[1].any()
        assert got.raw[5, 5] == np.float32(value)
        assert got.truth is None
        assert got.intrinsics is None
    l515 = open_("bytecameradepth", tmp_path, sensor="l515")
    assert [l515[i].name.rsplit("/")[-1] for i in (1, 2, 10)] == ["1", "2", "10"]
    assert open_("bytecameradepth", session, sensor="d455")[0].raw[2, 2] == np.float32(1.5)
    with pytest.raises(LabError, match="no true depth"):
        got.need_truth()


def test_bytecameradepth_as_depthrig_exports_it(tmp_path: Path) -> None:
    folder = tmp_path / "20260314_1512/camera_d455"
    make_bytes(folder, 1.5, 1e-4)
    stream = {"folder": "camera_d455", "prefix": "depth", "ending": "png", "depth_unit_m": 1e-4}
    stream["intrinsics"] = {
        "fx": 30.0,
        "fy": 30.0,
        "cx": 16.0,
        "cy": 12.0,
        "coeffs": [0.1, 0.0],
        "model": "brown_conrady",
    }
    (folder.parent / "calibration.json").write_text(json.dumps({"format": "x", "streams": [stream]}))
    got = open_("bytecameradepth", tmp_path)[0]
    assert got.raw[5, 5] == np.float32(1.5)
    lens = got.need_intrinsics("x")
    assert (lens.fx, lens.model, lens.coeffs) == (30, "brown_conrady", (0.1, 0))
    (folder.parent / "calibration.json").write_text("{")
    with pytest.raises(LabError, match=r"calibration\.json"):
        open_("bytecameradepth", tmp_path)


def test_a_wrong_unit_is_found_and_said(tmp_path: Path) -> None:
    # The tenths of a millimetre of a D405 taken for millimetres, and the reverse.
    make_bytes(tmp_path / "a/camera_d405", 0.35, 1e-4)
    with pytest.raises(LabError, match=r"median of 3\.5 m.*D405.*0\.1 or 0\.25 times its unit would fit"):
        open_("bytecameradepth", tmp_path / "a", unit_m=1e-3)
    make_bytes(tmp_path / "b/camera_d455", 1.5, 1e-3)
    with pytest.raises(LabError, match=r"median of 0\.15 m.*4 or 10 times its unit would fit"):
        open_("bytecameradepth", tmp_path / "b", unit_m=1e-4)
    # Against the truth: quarters of a millimetre in one of them.
    folder = make_hammer(tmp_path / "c", "scene2_traj1_1")
    for i in range(2):
        write(folder / f"depth_l515/{i:06d}.png", np.rint(depth(0.81) * 4000).astype(np.uint16))
    with pytest.raises(LabError, match=r"raw depth is 4\.05 times the truth"):
        open_("hammer", tmp_path / "c", sensor="l515")


def test_bad_images_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "camera_d455"
    make_bytes(folder, 1.5, 1e-3)
    source = open_("bytecameradepth", tmp_path)
    write(folder / "depth_0.png", np.full((H, W), 15, np.uint8))
    with pytest.raises(LabError, match=r"depth_0\.png: uint8"):
        source[0]
    write(folder / "depth_0.png", np.full((H // 2, W), 1500, np.uint16))
    with pytest.raises(LabError, match=r"depth_0\.png: colour is 32x24, depth 32x12"):
        source[0]
    data = (folder / "depth_1.png").read_bytes()
    (folder / "depth_1.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(LabError, match=r"depth_1\.png: damaged"):
        source[1]
    for n in range(3):
        write(folder / f"depth_{n}.png", np.zeros((H, W), np.uint16))
    with pytest.raises(LabError, match="raw depth is empty in all of 3"):
        open_("bytecameradepth", tmp_path)


def test_a_sample_refuses_what_does_not_fit() -> None:
    good = sample()
    for change in (
        {"raw": np.zeros((3, 3), np.float32)},
        {"truth": good.truth.astype(np.float64)},
        {"raw": np.full(good.raw.shape, np.nan, np.float32)},
        {"raw": np.full(good.raw.shape, -0.001, np.float32)},
        {"color": good.color[..., 0]},
    ):
        with pytest.raises(LabError, match="made"):
            Sample(**{**vars(good), **change})
    with pytest.raises(LabError, match="true depth is empty"):
        Sample(**{**vars(good), "truth": np.zeros_like(good.truth)}).need_truth()


def test_licences_are_printed_and_refused() -> None:
    said: list[str] = []
    two = {"ours": Licence("MIT", True), "dreds": Licence("CC BY-NC 4.0", False)}
    check_licences(two, ships=False, say=said.append)
    assert said == ["ours: licence MIT", "dreds: licence CC BY-NC 4.0, NOT for models that ship"]
    with pytest.raises(LabError, match=r"dreds \(CC BY-NC 4.0\)"):
        check_licences(two, ships=True, say=said.append)
    check_licences({"ours": two["ours"]}, ships=True, say=said.append)
    by_layout = {kind: loader.licence.ships for kind, loader in KINDS.items() if hasattr(loader, "licence")}
    assert [k for k, ships in by_layout.items() if not ships] == ["dreds", "std", "hiss", "hammer", "transcg"]


# depthrig's own datasets


def cdr(*fields: Any) -> bytes:
    out = bytearray(b"\x00\x01\x00\x00")
    for field in fields:
        if isinstance(field, bool):
            out += bytes([field])
            continue
        out += bytes(-len(out) % 4)
        if isinstance(field, int):
            out += field.to_bytes(4, "little")
        else:
            data = field.encode() + b"\0" if isinstance(field, str) else bytes(field)
            out += len(data).to_bytes(4, "little") + data
    return bytes(out)


def image(encoding: str, pixels: np.ndarray, pad: int = 0) -> bytes:
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, pad)))
    return cdr(0, 0, "f", height, width, encoding, False, rows.shape[1], rows.tobytes())


def make_dataset(folder: Path, damage: Callable[[dict[str, bytes]], None] = lambda _: None, pose: int = 0) -> None:
    writer_of = pytest.importorskip("mcap.writer", reason="mcap is not installed (the extra `lab`)")
    from depthrig.lab.images import encode_png

    folder.mkdir(parents=True)
    text = 'rig = "mount"\n'
    for name, p in (("color", 0), ("depth", pose), ("refined", 0)):
        text += f'[[streams]]\nid = "d405/{name}"\nmodel = "Intel RealSense D405"\nwidth = {W}\nheight = {H}\n'
        text += f"pose = [{p}]\n"
        text += "intrinsics = { fx = 40.0, fy = 40.0, cx = 16.0, cy = 12.0 }\n"
    (folder / "session.toml").write_text(text)
    with (folder / "seg_0000.mcap").open("wb") as f:
        writer = writer_of.Writer(f)
        writer.start("ros2")
        schema = writer.register_schema("x", "ros2msg", b"")
        channels: dict[str, int] = {}

        def put(topic: str, data: bytes, time: int) -> None:
            if topic not in channels:
                unit = {"depth_unit_m": "0.0001"}
                channels[topic] = writer.register_channel(topic, "cdr", schema, unit)
            writer.add_message(channels[topic], time, data, time)

        for i in range(3):
            time = 1000 + i
            units = np.tile((4000 + i + np.arange(W)).astype("<u2"), (H, 1))
            units[0], units[1] = 0, 65535
            metres = depth(0.41).astype("<f4")
            metres[0] = np.nan
            messages = {
                "color/image_compressed": cdr(0, 0, "f", "png", encode_png(color())),
                "depth/image_raw": image("16UC1", units, pad=6),
                "refined/image_raw": image("32FC1", metres),
            }
            damage(messages)
            for topic, data in messages.items():
                put(f"/mount/d405/{topic}", data, time)
            for name in ("color", "depth", "refined"):
                put(f"/mount/d405/{name}/camera_info", b"", time)
            # The last one was not finished.
            if i < 2:
                put("/mount/frame_set", b"", time)
        writer.finish()


def test_our_own_datasets(tmp_path: Path) -> None:
    make_dataset(tmp_path / "one")
    source = open_("depthrig", tmp_path / "one", sensor="d405")
    assert len(source) == 2
    assert source.sensor == "d405"
    got = source[1]
    np.testing.assert_array_equal(got.color, color())
    assert not got.raw[:2].any()
    np.testing.assert_allclose(got.raw[2:], np.tile(0.4001 + 1e-4 * np.arange(W), (H - 2, 1)), rtol=1e-6)
    assert got.truth is None
    assert got.intrinsics.fx == 40
    both = open_("depthrig", tmp_path, sensor="d405", reference="d405/refined")
    assert both[0].truth[5, 5] == np.float32(0.41)
    assert both[0].truth[0, 0] == 0
    with pytest.raises(LabError, match="no stream d435/color"):
        open_("depthrig", tmp_path, sensor="d435")
    with pytest.raises(LabError, match="name a camera"):
        open_("depthrig", tmp_path)


def test_our_own_datasets_with_damage(tmp_path: Path) -> None:
    make_dataset(tmp_path / "a", pose=1)
    with pytest.raises(LabError, match="another pose.*not registered"):
        open_("depthrig", tmp_path / "a", sensor="d405")

    def cut(messages: dict[str, bytes]) -> None:
        messages["depth/image_raw"] = messages["depth/image_raw"][:-9]

    make_dataset(tmp_path / "b", cut)
    with pytest.raises(LabError, match="depth/image_raw: message cut short; run `depthrig verify`"):
        open_("depthrig", tmp_path / "b", sensor="d405")

    def yuv(messages: dict[str, bytes]) -> None:
        messages["color/image_raw"] = image("yuv422", np.zeros((H, 2 * W), np.uint8))
        del messages["color/image_compressed"]

    make_dataset(tmp_path / "c", yuv)
    with pytest.raises(LabError, match="pixels of yuv422"):
        open_("depthrig", tmp_path / "c", sensor="d405")
    make_dataset(tmp_path / "d")
    path = tmp_path / "d/seg_0000.mcap"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(LabError, match=r"seg_0000\.mcap"):
        open_("depthrig", tmp_path / "d", sensor="d405")
