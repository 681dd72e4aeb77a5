"""Cards, the way of images to a network and back, and networks in ONNX files."""

import builtins
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from geogs.errors import InputError
from geogs.extras import install_command
from geogs.geometry.camera import Camera
from geogs.priors.card import PriorCard, card_names, load_card
from geogs.priors.monocular_prior import DepthKind, MonocularPrior
from geogs.priors.onnx import OnnxPrior, fit_image

CAMERA = Camera(60.0, 61.0, 31.0, 23.5, 64, 48)
PLAIN = PriorCard("plain", "here", "none", height=48, width=64, depth_kind="metric")


def image(height: int = 48, width: int = 64) -> np.ndarray:
    """Red rises to the right, green downwards, blue is constant."""
    out = np.zeros((height, width, 3), np.uint8)
    out[..., 0] = np.linspace(0, 255, width).astype(np.uint8)
    out[..., 1] = np.linspace(0, 255, height).astype(np.uint8)[:, None]
    out[..., 2] = 51
    return out


def test_shipped_cards_are_complete():
    names = card_names()
    assert {"depth-anything-v2-small", "metric3d-v2-small", "dsine"} <= set(names)
    assert {"omnidata-depth", "omnidata-normal"} <= set(names)
    for name in names:
        card = load_card(name)
        assert len(card.source) > 20
        assert len(card.licence) > 5
        assert card.depth_kind is not None or card.axes is not None
    assert load_card("depth-anything-v2-small").kind is DepthKind.AFFINE_INVERSE
    assert load_card("dsine").axes == (-1.0, -1.0, -1.0)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("name: x\nheight: 4\n", r"does not say source, licence\.$"),
        (
            "name: x\nsource: y\nlicence: z\nresize: shrink\ndepth_kind: metric",
            "resize must be stretch",
        ),
        ("name: x\nsource: y\nlicence: z\nheight: 4\nwidth: 4", "neither depth"),
        ("name: x\nsource: y\nlicence: z\ncolour: red", "colour"),
        ("name: x\nsource: y\nlicence: z\nheight: tall\ndepth_kind: metric", "height"),
        ("name: x\nsource: y\nlicence: z\nmean: [a, b, c]\ndepth_kind: metric", "mean"),
        ("name: x\nsource: y\nlicence: z\ndepth_kind: metric", "positive"),
        ("name: x\nsource: y\nlicence: z\nresize: multiple\nnormal_axes: +x+z+y", "normal_axes"),
        ("- 1", "list of settings"),
        ("a: [", "not YAML"),
    ],
)
def test_wrong_cards_are_told_in_a_sentence(tmp_path: Path, text: str, what: str):
    path = tmp_path / "card.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=what) as error:
        load_card(str(path))
    assert str(error.value).count("\n") == 0


def test_an_unknown_card_names_those_there_are():
    with pytest.raises(InputError, match="depth-anything-v2-small"):
        load_card("nothing")


def test_sizes_follow_the_rule():
    anything = load_card("depth-anything-v2-small")
    assert fit_image(image(384, 512), anything).pixels.shape == (1, 3, 518, 686)  # 690.7 to 14 * 49
    assert fit_image(image(512, 384), anything).pixels.shape == (1, 3, 686, 518)
    metric = fit_image(image(384, 512), load_card("metric3d-v2-small"))
    assert metric.pixels.shape == (1, 3, 616, 1064)
    assert metric.inner == (616, 821)
    assert (metric.top, metric.left) == (0, 121)
    padded = fit_image(image(50, 70), load_card("dsine"))
    assert padded.pixels.shape == (1, 3, 64, 96)
    assert (padded.top, padded.left) == (7, 13)


def test_colours_are_scaled_normalised_ordered_and_padded():
    card = replace(
        PLAIN, resize="pad", height=48, width=80, mean=(0.5, 0.4, 0.1), std=(0.5, 0.2, 0.05),
        padding=(1.0, 0.0, 0.2),
    )  # fmt: skip
    pixels = fit_image(image(), card).pixels[0]
    np.testing.assert_allclose(pixels[:, 0, 8 + 63], [1.0, -2.0, 2.0], atol=1e-5)
    np.testing.assert_allclose(pixels[:, 20, 3], [1.0, -2.0, 2.0], atol=1e-5)  # padding
    bgr = fit_image(image(), replace(card, channels="bgr")).pixels[0]
    np.testing.assert_array_equal(bgr, pixels[::-1])
    raw = fit_image(image(), replace(PLAIN, full_scale=255.0)).pixels[0]
    np.testing.assert_allclose(raw[2], 51.0)


@pytest.mark.parametrize("resize", ["stretch", "at_least", "pad", "multiple"])
def test_maps_come_back_to_where_they_belong(resize: str):
    """A map that is linear in the image's coordinates is so again at the image's size."""
    card = replace(PLAIN, resize=resize, height=90, width=140, multiple=16)
    fitted = fit_image(image(), card)
    K = fitted.camera(CAMERA)[0]
    v, u = np.mgrid[: fitted.pixels.shape[2], : fitted.pixels.shape[3]].astype(np.float32)
    ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]], -1)
    back = fitted.back(ray)
    true = CAMERA.rays().numpy()[..., :2]
    assert back.shape == true.shape
    np.testing.assert_allclose(back[3:-3, 3:-3], true[3:-3, 3:-3], atol=2e-3)


def export(path: Path, outputs: list[str], camera: bool = False) -> Path:
    """A network whose depth is twice red plus a half and whose normal is its colours.

    With a camera it adds the principal point's x to depth.
    """
    onnx = pytest.importorskip("onnx", reason="onnx is not installed")
    pytest.importorskip("onnxruntime", reason="onnxruntime is not installed")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    size = [1, 3, "h", "w"]
    inputs = [helper.make_tensor_value_info("image", kind, size)]
    weight = np.zeros((4, 3, 1, 1), np.float32)
    weight[0, 0], weight[1, 0], weight[2, 1], weight[3, 2] = 2, 1, 1, 1
    bias = np.array([0.5, 0, 0, 0], np.float32)
    constants = {"weight": weight, "bias": bias, "split": np.array([1, 3], np.int64)}
    nodes = [
        helper.make_node("Conv", ["image", "weight", "bias"], ["both"]),
        helper.make_node("Split", ["both", "split"], ["plain", "normal"], axis=1),
    ]
    if camera:
        inputs.append(helper.make_tensor_value_info("K", kind, [1, 3, 3]))
        constants["place"] = np.array([2], np.int64)
        nodes += [
            helper.make_node("Reshape", ["K", "flat"], ["row"]),
            helper.make_node("Gather", ["row", "place"], ["cx"]),
            helper.make_node("Add", ["plain", "cx"], ["depth"]),
        ]
        constants["flat"] = np.array([9], np.int64)
    else:
        nodes.append(helper.make_node("Identity", ["plain"], ["depth"]))
    graph = helper.make_graph(
        nodes, "small", inputs,
        [helper.make_tensor_value_info(n, kind, [1, "c", "h", "w"]) for n in outputs],
        [onnx.numpy_helper.from_array(v, k) for k, v in constants.items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)])
    model.ir_version = 8
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return path


def test_depth_of_a_network(tmp_path: Path):
    prior = OnnxPrior(export(tmp_path / "depth.onnx", ["depth"]), PLAIN, CAMERA)
    assert isinstance(prior, MonocularPrior)
    maps = prior.predict(image())
    assert maps.kind is DepthKind.METRIC
    assert maps.normal is None
    expected = 2 * torch.from_numpy(image()[..., 0] / 255.0).float() + 0.5
    torch.testing.assert_close(maps.depth, expected, rtol=0, atol=1e-5)
    clamped = OnnxPrior(tmp_path / "depth.onnx", replace(PLAIN, depth_range=(1.0, 2.0)), CAMERA)
    depth = clamped.predict(image()).depth
    assert (float(depth.min()), float(depth.max())) == (1.0, 2.0)


def test_a_network_at_another_size(tmp_path: Path):
    card = replace(PLAIN, resize="at_least", height=70, width=70, multiple=14)
    prior = OnnxPrior(export(tmp_path / "depth.onnx", ["depth"]), card, CAMERA)
    depth = prior.predict(image()).depth
    expected = 2 * torch.from_numpy(image()[..., 0] / 255.0).float() + 0.5
    assert depth.shape == (48, 64)
    torch.testing.assert_close(depth, expected, rtol=0, atol=0.02)


def test_normals_of_a_network_in_our_axes(tmp_path: Path):
    card = replace(
        PLAIN, depth_kind=None, normal_output="normal", normal_axes="+x-y-z", normal_scale=2.0,
        normal_offset=-1.0,
    )  # fmt: skip
    prior = OnnxPrior(export(tmp_path / "both.onnx", ["depth", "normal"]), card, CAMERA)
    maps = prior.predict(image())
    assert maps.depth is None
    raw = torch.from_numpy(2 * (image() / 255.0) - 1).float() * torch.tensor([1.0, -1.0, -1.0])
    torch.testing.assert_close(maps.normal, raw / raw.norm(dim=-1, keepdim=True), rtol=0, atol=1e-4)
    short = replace(card, normal_scale=0.1, normal_offset=0.0)
    dull = OnnxPrior(tmp_path / "both.onnx", short, CAMERA).predict(image())
    assert float(dull.normal.norm(dim=-1).max()) == 0.0


def test_a_network_that_asks_for_the_camera(tmp_path: Path):
    card = replace(PLAIN, resize="multiple", multiple=80, camera_input="K")
    prior = OnnxPrior(export(tmp_path / "camera.onnx", ["depth"], camera=True), card, CAMERA)
    depth = prior.predict(image()).depth
    assert float(depth[0, 0]) == pytest.approx(0.5 + CAMERA.cx + 8, abs=1e-4)  # padded 64 to 80


def test_what_does_not_fit_is_told_in_a_sentence(tmp_path: Path):
    path = export(tmp_path / "both.onnx", ["depth", "normal"])
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"no network")
    wrong = [
        (path, PLAIN, "depth_output.*depth, normal"),
        (path, replace(PLAIN, depth_output="z"), "no output z.*depth, normal"),
        (path, replace(PLAIN, depth_output="depth", image_input="rgb"), "no input rgb"),
        (tmp_path / "none.onnx", PLAIN, "no file"),
        (broken, PLAIN, "no ONNX network"),
    ]
    for file, card, message in wrong:
        with pytest.raises(InputError, match=message):
            OnnxPrior(file, card, CAMERA)
    odd = OnnxPrior(path, replace(PLAIN, depth_output="normal"), CAMERA)
    with pytest.raises(InputError, match=r"shape \(1, 3, 48, 64\)"):
        odd.predict(image())


def test_without_onnxruntime_one_sentence_says_what_to_install(monkeypatch, tmp_path: Path):
    real = builtins.__import__

    def absent(name: str, *rest, **more):
        if name == "onnxruntime":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(InputError, match=re.escape(install_command("priors"))):
        OnnxPrior(tmp_path / "any.onnx", PLAIN, CAMERA)
