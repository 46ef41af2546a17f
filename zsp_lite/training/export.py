"""Export of trained weights, and import of weights from which a further run starts."""

from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor, nn

from zsp_lite.backbones.backbone import IMAGENET_MEAN, IMAGENET_STD, normalize
from zsp_lite.backbones.load import load_backbone
from zsp_lite.backbones.photo_informed import TRANSFORMER, PhotoInformedViT
from zsp_lite.backbones.pretrained import EMBEDDED
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.errors import InputError
from zsp_lite.training.batches import MEAN, STD
from zsp_lite.training.loop import read_checkpoint
from zsp_lite.training.recipe import TrainingConfig
from zsp_lite.training.renders import RenderSet
from zsp_lite.training.trainee import Trainee

_TRAINING_SCALING, _IMAGENET_SCALING = ((MEAN,) * 3, (STD,) * 3), (IMAGENET_MEAN, IMAGENET_STD)


@torch.no_grad()
def export_checkpoint(model: Trainee, renders: RenderSet, config: TrainingConfig, path: Path) -> Path:
    """Write the backbone as a float16 .safetensors file that any code for DINO's ViT loads.

    Two changes leave the features the same: the mean key of every block, computed from `renders` at 224 px, is
    subtracted in its key bias (attention is invariant to a constant added to all keys; cosine similarities of keys
    become meaningful), and the normalisation of the training crops is replaced by ImageNet's in the patch embedding.

    Returns:
        The path.
    """
    backbone = VisionTransformer(224, 8, config.embed_dim, config.depth, config.num_heads)
    backbone.load_state_dict(model.backbone.state_dict())
    images = normalize(_export_images(renders, 224), *_TRAINING_SCALING)
    dim = config.embed_dim
    x, _ = backbone.embed(images)
    for block, activations in zip(backbone.blocks, backbone.run_blocks(x), strict=True):
        block.attn.qkv.bias[dim : 2 * dim] -= activations.key[:, 1:].mean((0, 1))
    _rescale_input(backbone, _TRAINING_SCALING, _IMAGENET_SCALING)
    metadata = {"name": path.stem, "patch_size": "8", "image_size": "224", "num_heads": str(config.num_heads)}
    metadata |= {"key_block": str(config.layer), "saliency_heads": ",".join(map(str, range(config.num_heads)))}
    return _write({name: value.half() for name, value in backbone.state_dict().items()}, metadata, path)


@torch.no_grad()
def export_photo_input(model: Trainee, renders: RenderSet, backbone: Path, path: Path) -> Path:
    """Write the photo input of an exported backbone: the projection, and the mean key of every block with that input.

    Args:
        model: Network that was trained with photo features.
        renders: Objects from which the mean keys are computed, at 224 px.
        backbone: File that `export_checkpoint` wrote.
        path: File to write.

    Returns:
        The path.
    """
    network = PhotoInformedViT(load_backbone(backbone, "cpu").model)
    network.photo_input.projection.load_state_dict(model.photo_projection.state_dict())
    parts = _export_images(renders, network.image_size).split(8)
    for part in parts:
        x, _ = network.vit.embed(*network.inputs(part)[:2])
        for mean, activations in zip(network.photo_input.key_mean, network.vit.run_blocks(x), strict=True):
            mean += activations.key[:, 1:].mean((0, 1)) / len(parts)
    weights = {name: value.half() for name, value in network.photo_input.state_dict().items()}
    return _write(weights, {"name": path.stem, TRANSFORMER: backbone.name}, path)


def export_convolutional(network: nn.Module, path: Path) -> Path:
    """Write a network with batch norms as a .safetensors file: float16, but float32 for the running statistics.

    Running statistics may exceed the range of float16.

    Returns:
        The path.
    """
    state = {name: x for name, x in network.state_dict().items() if not name.endswith("num_batches_tracked")}
    weights = {name: value if "running_" in name else value.half() for name, value in state.items()}
    return _write(weights, {"name": path.stem}, path)


def starting_weights(config: TrainingConfig, source: str | Path) -> dict[str, Tensor]:
    """Read the weights of a `Trainee` from which a run starts.

    Args:
        config: Configuration of the run.
        source: The checkpoint.pt of a run of `train`, whose averaged weights are taken; an exported .safetensors file;
            or the name of embedded weights, such as "zsp-tiny". Exported weights have no heads. Those of a photo input
            come with its transformer's.

    Raises:
        InputError: If the file does not exist, is damaged, or has a network of another size.
    """
    path = weights_file(source)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "no such file"
        kinds = "a checkpoint of `train`, exported .safetensors, or the name of embedded weights"
        raise InputError(f"{source}: {what}, expected {kinds}")
    trainee = Trainee(config)
    if path.suffix != ".safetensors":
        prefix, state = "average.", read_checkpoint(path)["task"]
        weights = {name.removeprefix(prefix): x for name, x in state.items() if name.startswith(prefix)}
        try:
            trainee.load_state_dict(weights)
        except RuntimeError as error:
            size = f"{config.depth} blocks, {config.embed_dim} wide"
            raise InputError(f"{path}: a network of another shape, expected {size}") from error
        return weights
    backbone = load_backbone(path, "cpu").model
    if isinstance(backbone, PhotoInformedViT):
        if not config.photo_share:
            raise InputError(
                f"{source}: has a photo input, expected a transformer alone for a run without photo features"
            )
        photo_input, backbone = backbone.photo_input, backbone.vit
        trainee.photo_projection.load_state_dict(photo_input.projection.state_dict())
        trainee.photo_key_mean.copy_(photo_input.key_mean[config.layer])
    sizes = ("depth", "embed_dim", "num_heads", "patch_size", "image_size")
    found, expected = ({name: getattr(model, name) for name in sizes} for model in (backbone, trainee.backbone))
    if found != expected:
        raise InputError(f"{source}: a network of another shape, {found}, expected {expected}")
    trainee.backbone.load_state_dict(backbone.state_dict())
    _rescale_input(trainee.backbone, _IMAGENET_SCALING, _TRAINING_SCALING)
    return {name: value for name, value in trainee.state_dict().items() if not name.startswith("geometry")}


def weights_file(source: str | Path) -> Path:
    """Return the path of a source of `starting_weights`."""
    return EMBEDDED.get(str(source), Path(source).expanduser())


@torch.no_grad()
def _rescale_input(backbone: VisionTransformer, old: tuple, new: tuple) -> None:
    """Change the patch embedding from the normalisation `old` (mean, standard deviation) of its input to `new`."""
    (mean, std), (new_mean, new_std) = (
        [torch.as_tensor(values).view(1, 3, 1, 1) for values in scaling] for scaling in (old, new)
    )
    proj = backbone.patch_embed.proj
    proj.bias += (proj.weight * (new_mean - mean) / std).sum((1, 2, 3))
    proj.weight *= new_std / std


def _write(weights: dict[str, Tensor], metadata: dict[str, str], path: Path) -> Path:
    save_file({name: value.contiguous() for name, value in weights.items()}, path, metadata=metadata)
    path.chmod(0o644)  # safetensors makes files that only their owner can read
    return path


def _export_images(renders: RenderSet, side: int) -> Tensor:
    """Return views in [0, 1] from which mean keys are computed."""
    rgb = torch.from_numpy(renders.rgb[:24, ::3].reshape(-1, *renders.rgb.shape[2:])).permute(0, 3, 1, 2)
    return F.interpolate(rgb.float() / 255, (side, side), mode="bilinear")
