"""Parts of the OAK bridge that need no SDK: lenses, versions, and the messages without the SDK."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest

from depthrig._layout import Distortion
from depthrig.oak import _lens, _sdk
from depthrig.oak.__main__ import main
from depthrig.oak._errors import Exit, OakError


@pytest.mark.parametrize(
    ("model", "coefficients", "expected"),
    [
        ("Perspective", [0.0] * 14, (Distortion.NONE, ())),
        ("Perspective", [], (Distortion.NONE, ())),
        ("Perspective", [0.1, 0.2, 0.3, 0.4, 0.5] + [0.0] * 9, (Distortion.BROWN_CONRADY, (0.1, 0.2, 0.3, 0.4, 0.5))),
        (
            "Perspective",
            [1, 2, 3, 4, 5, 6, 7, 8, 0, 0, 0, 0, 0, 0],
            (Distortion.RATIONAL, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0)),
        ),
        ("Fisheye", [0.1, 0.2, 0.3, 0.4], (Distortion.KANNALA_BRANDT4, (0.1, 0.2, 0.3, 0.4))),
    ],
)
def test_lenses_are_named_as_a_frame_names_them(
    model: str, coefficients: list[float], expected: tuple[Distortion, tuple[float, ...]]
) -> None:
    assert _lens.distortion(model, coefficients) == expected


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("Perspective", [0.1] * 9), ("Fisheye", [0.1] * 5), ("Equirectangular", [0.1]), ("RadialDivision", [0.1])],
)
def test_a_lens_that_no_header_can_describe_is_an_error(model: str, coefficients: list[float]) -> None:
    with pytest.raises(OakError, match=f"a {model} model with {len(coefficients)} coefficients.*--keep-distortion"):
        _lens.distortion(model, coefficients)


def test_intrinsics_fill_the_header() -> None:
    lens = _lens.intrinsics([[500, 0, 320.5], [0, 501, 240.5], [0, 0, 1]], Distortion.BROWN_CONRADY, [0.1, 0.2])
    assert lens == (500.0, 501.0, 320.5, 240.5, (0.1, 0.2, 0, 0, 0, 0, 0, 0), 2, 0)
    assert not _lens.unknown().is_known


@pytest.mark.parametrize("version", ["3.12.0", "3.13.1", "3.99.0.dev1"])
def test_versions_that_are_taken(version: str) -> None:
    _sdk.check_version(SimpleNamespace(__version__=version))


@pytest.mark.parametrize("version", ["2.30.0.0", "3.11.9", "4.0.0", "main"])
def test_versions_that_are_not(version: str) -> None:
    with pytest.raises(OakError, match=f"`depthai` {version} is installed, 3.12 or a later 3 is needed") as e:
        _sdk.check_version(SimpleNamespace(__version__=version))
    assert e.value.code is Exit.USAGE


def test_without_the_sdk_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "depthai", None)
    assert main(["--list"]) == Exit.USAGE
    assert "the `depthai` package cannot be imported" in caplog.text
    assert "pip install './python[oak]'" in caplog.text


@pytest.mark.parametrize(
    "arguments",
    [
        ["--size", "wide"],
        ["--fps", "0"],
        ["--fps", "nan"],
        ["--dots", "1.5"],
        ["--color", "mjpeg"],
        ["--streams", "ir"],
    ],
)
def test_a_wrong_option_is_refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as e:
        main(arguments)
    assert e.value.code == 2
    assert arguments[0] in capsys.readouterr().err
