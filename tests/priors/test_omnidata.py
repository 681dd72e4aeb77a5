"""Omnidata's network: names and shapes as published, numbers as timm's, checkpoints strictly."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from fixtures.make_vit_hybrid_oracle import formula, picture, sample
from geogs.errors import InputError
from geogs.priors.card import load_card
from geogs.priors.dpt import DptHybrid, Fusion, TokenReadout
from geogs.priors.fitting import fit_image
from geogs.priors.monocular_prior import DepthKind, MonocularPrior
from geogs.priors.omnidata import OmnidataPrior
from geogs.priors.vit_hybrid import HybridTransformer, StandardisedConv, pad_same

ORACLE = Path(__file__).parents[1] / "fixtures" / "vit_hybrid.json"

Shapes = dict[str, tuple[int, ...]]


def published_names(channels: int) -> Shapes:
    """Names and shapes from the published architecture: ResNet-50's first three stages, ViT-B/16,
    the reassembling and the decoder of DPT.
    """
    names: Shapes = {}

    def both(name: str, *weight: int) -> None:
        names[f"{name}.weight"], names[f"{name}.bias"] = weight, weight[:1]

    vit = "pretrained.model."
    names |= {vit + "cls_token": (1, 1, 768), vit + "pos_embed": (1, 577, 768)}
    stem = vit + "patch_embed.backbone."
    names[stem + "stem.conv.weight"] = (64, 3, 7, 7)
    both(stem + "stem.norm", 64)
    before = 64
    for stage, (blocks, out) in enumerate([(3, 256), (4, 512), (9, 1024)]):
        for n in range(blocks):
            block, middle = f"{stem}stages.{stage}.blocks.{n}.", out // 4
            if n == 0:
                names[block + "downsample.conv.weight"] = (out, before, 1, 1)
                both(block + "downsample.norm", out)
            names[block + "conv1.weight"] = (middle, before, 1, 1)
            names[block + "conv2.weight"] = (middle, middle, 3, 3)
            names[block + "conv3.weight"] = (out, middle, 1, 1)
            for k, width in ((1, middle), (2, middle), (3, out)):
                both(f"{block}norm{k}", width)
            before = out
    both(vit + "patch_embed.proj", 768, 1024, 1, 1)
    for n in range(12):
        block = f"{vit}blocks.{n}."
        both(block + "norm1", 768)
        both(block + "attn.qkv", 2304, 768)
        both(block + "attn.proj", 768, 768)
        both(block + "norm2", 768)
        both(block + "mlp.fc1", 3072, 768)
        both(block + "mlp.fc2", 768, 3072)
    both(vit + "norm", 768)
    both(vit + "head", 1000, 768)
    for k in (3, 4):
        both(f"pretrained.act_postprocess{k}.0.project.0", 768, 1536)
        both(f"pretrained.act_postprocess{k}.3", 768, 768, 1, 1)
    both("pretrained.act_postprocess4.4", 768, 768, 3, 3)
    for n, width in enumerate((256, 512, 768, 768), 1):
        names[f"scratch.layer{n}_rn.weight"] = (256, width, 3, 3)
        both(f"scratch.refinenet{n}.out_conv", 256, 256, 1, 1)
        for unit in (1, 2):
            for conv in (1, 2):
                both(f"scratch.refinenet{n}.resConfUnit{unit}.conv{conv}", 256, 256, 3, 3)
    both("scratch.output_conv.0", 128, 256, 3, 3)
    both("scratch.output_conv.2", 32, 128, 3, 3)
    both("scratch.output_conv.4", channels, 32, 1, 1)
    return names


def test_names_and_shapes_are_the_published_ones():
    for channels in (1, 3):
        with torch.device("meta"):
            ours = DptHybrid(channels).state_dict()
        expected = published_names(channels)
        assert {k: tuple(v.shape) for k, v in ours.items()} == expected
        assert len(expected) == 368
    assert sum(int(np.prod(s)) for s in published_names(1).values()) == 123_146_985


def test_the_backbone_computes_what_timms_does():
    with torch.device("meta"):
        ours = HybridTransformer()
    weights = {k: formula(n, v.shape, k) for n, (k, v) in enumerate(ours.state_dict().items())}
    ours.load_state_dict(weights, assign=True)
    with torch.inference_mode():
        maps, tokens = ours(picture(), (0, 1), (8, 11))
    assert [m.shape[1:] for m in maps] == [(256, 16, 24), (512, 8, 12)]
    expected = json.loads(ORACLE.read_text())["values"]
    for k, found in enumerate([*maps, *tokens]):
        true = torch.tensor(expected[k])
        assert float(true.std()) > 0.3
        torch.testing.assert_close(sample(found), true, rtol=1e-4, atol=1e-4 * float(true.std()))


def test_same_padding_puts_the_odd_pixel_last():
    x = torch.ones(1, 1, 8, 7)
    padded = pad_same(x, 3, 2, 0.0)
    assert padded.shape == (1, 1, 9, 9)
    assert padded[0, 0, -1].sum() == 0
    assert padded[0, 0, 0].tolist() == [0, *[1] * 7, 0]


def test_filters_have_mean_zero_and_variance_one():
    conv = StandardisedConv(4, 8, 3)
    constant = conv(torch.full((1, 4, 9, 9), 3.0))[..., 2:-2, 2:-2].detach()
    assert float(constant.abs().max()) < 1e-4
    impulse = torch.zeros(1, 4, 9, 9)
    impulse[0, 1, 4, 4] = 1
    scaled = StandardisedConv(4, 8, 3)
    scaled.load_state_dict({"weight": 100 * conv.weight.detach() + 7})
    torch.testing.assert_close(conv(impulse), scaled(impulse), rtol=1e-4, atol=1e-5)


def test_fusion_doubles_and_readout_drops_the_class_token():
    with torch.inference_mode():
        fused = Fusion()(torch.rand(1, 256, 3, 4), torch.rand(1, 256, 3, 4))
        rest = TokenReadout()(torch.rand(2, 7, 768))
    assert fused.shape == (1, 256, 6, 8)
    assert rest.shape == (2, 6, 768)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory) -> Path:
    """Normals like those of a published file, of an untrained network whose bias is 0.5, 0.5, 0."""
    torch.manual_seed(0)
    weights = DptHybrid(3).state_dict()
    weights["scratch.output_conv.4.weight"] *= 0.05
    weights["scratch.output_conv.4.bias"] = torch.tensor([0.7, 0.5, 0.1])
    path = tmp_path_factory.mktemp("omnidata") / "normal.ckpt"
    torch.save({"state_dict": {f"model.{k}": v for k, v in weights.items()}, "epoch": 3}, path)
    return path


def test_normals_of_a_checkpoint(checkpoint: Path):
    card = load_card("omnidata-normal")
    prior = OmnidataPrior(checkpoint, card)
    assert isinstance(prior, MonocularPrior)
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (48, 64, 3), np.uint8)
    assert fit_image(image, card).pixels.shape == (1, 3, 384, 512)
    prior.card = replace(card, height=96, width=96)  # which takes a tenth of the time
    seen = []
    prior.network.register_forward_pre_hook(lambda _, x: seen.append(x[0]))
    prior.network.register_forward_hook(lambda *x: seen.append(x[2]))
    maps = prior.predict(image)
    assert seen[0].shape == (1, 3, 96, 128)
    assert float(seen[0].min()) >= 0  # plain [0, 1], no other normalisation
    assert 0.9 < float(seen[0].max()) <= 1
    assert seen[1].shape == (1, 3, 96, 128)
    assert maps.depth is None
    torch.testing.assert_close(maps.normal.norm(dim=-1), torch.ones(48, 64))
    raw = 2 * torch.nn.functional.interpolate(seen[1], (48, 64), mode="area")[0] - 1
    unit = torch.nn.functional.normalize(raw, dim=0).permute(1, 2, 0)
    assert float((unit * maps.normal).sum(-1).min()) > 0.98
    assert float(maps.normal[..., 2].max()) < 0  # faces the camera


def test_depth_is_normalised_and_clamped(checkpoint: Path, monkeypatch):
    card = load_card("omnidata-depth")
    monkeypatch.setattr("geogs.priors.omnidata.load_checkpoint", lambda network, path: None)
    monkeypatch.setattr("geogs.priors.omnidata.DptHybrid", _Brightness)
    prior = OmnidataPrior(checkpoint, card)
    image = np.zeros((64, 64, 3), np.uint8)
    image[:, 32:] = 255
    maps = prior.predict(image)
    assert maps.kind is DepthKind.AFFINE_DEPTH
    # Black becomes -1, white 1; the made-up network gives 0.8 + their double.
    assert float(maps.depth[:, :16].max()) == 0.0
    assert float(maps.depth[:, -16:].min()) == 1.0


class _Brightness(torch.nn.Module):
    """Stands for the network: depth is 0.8 plus twice the input's mean."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return 0.8 + 2 * x.mean(1, keepdim=True).expand(-1, self.channels, -1, -1)


def test_checkpoints_that_do_not_fit_are_told_in_a_sentence(tmp_path: Path):
    normal, depth = load_card("omnidata-normal"), load_card("omnidata-depth")
    zero, names = torch.zeros(1), published_names(3).items()
    weights = {f"model.{k}": zero.expand(shape) for k, shape in names}  # of one number in the file
    torch.save({"state_dict": weights}, tmp_path / "normal.ckpt")
    OmnidataPrior(tmp_path / "normal.ckpt", normal)
    with pytest.raises(InputError, match=r"shape scratch\.output_conv\.4"):
        OmnidataPrior(tmp_path / "normal.ckpt", depth)
    cases = {"lacks pretrained.model.cls_token": dict(weights), "besides, extra": dict(weights)}
    cases["lacks pretrained.model.cls_token"].pop("model.pretrained.model.cls_token")
    cases["besides, extra"]["model.extra"] = torch.zeros(1)
    for n, (message, content) in enumerate(cases.items()):
        torch.save({"state_dict": content}, tmp_path / f"{n}.ckpt")
        with pytest.raises(InputError, match=message):
            OmnidataPrior(tmp_path / f"{n}.ckpt", normal)
    (tmp_path / "text.ckpt").write_text("nothing")
    torch.save({"state_dict": {}}, tmp_path / "empty.ckpt")
    torch.save({"state_dict": {}, "other": Path("x")}, tmp_path / "unsafe.ckpt")
    wrong = {"text": "text.ckpt", "empty": "no weights", "none": "no file", "unsafe": "for safety"}
    for name, message in wrong.items():
        with pytest.raises(InputError, match=message):
            OmnidataPrior(tmp_path / f"{name}.ckpt", normal)
