"""Vision transformers in Hugging Face's format: DINOv2, DINOv3, ViT, DeiT, CLIP's image encoder and
similar models.

Attention, block outputs and the CLS token are outputs of the transformers library; queries, keys
and values, which it does not return, are recorded by a forward hook on their projection. The code
does not depend on the architecture. It needs the package transformers, which is imported on first
use.
"""

import inspect
import os
from collections.abc import Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from zsp_lite.backbones.backbone import IMAGENET_MEAN, IMAGENET_STD, Backbone
from zsp_lite.backbones.checkpoints import one_line
from zsp_lite.backbones.load import PREFIX, BackboneConfig
from zsp_lite.backbones.vit import Tokens, nearest_multiple
from zsp_lite.choices import Facet
from zsp_lite.errors import InputError

IMAGE_SIZE = 224  # default, pixels: the paper's
CONFIG = "config.json"
PROCESSORS = ("preprocessor_config.json", "processor_config.json")
WEIGHTS = ("model.safetensors", "model.safetensors.index.json")
# The only files that are downloaded or read: safetensors, no pickle files, no code.
FILES = (CONFIG, *PROCESSORS, *WEIGHTS, "model*.safetensors")
# For each facet, the names that architectures give to its linear layer.
_PROJECTIONS = {
    "query": ("q_proj", "query"),
    "key": ("k_proj", "key"),
    "value": ("v_proj", "value"),
}
# Names of parameters: those of the CLS token, and those of all tokens that precede the patches.
_CLS = {"cls_token", "class_token", "class_embedding"}
_BEFORE_PATCHES = (*_CLS, "register_tokens", "distillation_token")

# Mean and standard deviation that normalise RGB values in [0, 1].
Normalisation = tuple[Sequence[float], Sequence[float]]


class HuggingFaceViT(nn.Module):
    """A Hugging Face model with the attributes and the `extract` of `vit.VisionTransformer`.

    The model must compute attention eagerly, so that it returns it. InputError if it has no CLS
    token or no query, key and value projections in every block, or does not run on images of
    `image_size`.
    """

    def __init__(self, model: nn.Module, config: Any, image_size: int, name: str):
        super().__init__()
        self.vit = model
        self.num_heads = getattr(config, "num_attention_heads", None)
        self.depth = getattr(config, "num_hidden_layers", None)
        self.patch_size = getattr(config, "patch_size", None)
        # Some architectures give both sides of a patch.
        if isinstance(self.patch_size, (list, tuple)) and len(set(self.patch_size)) == 1:
            self.patch_size = self.patch_size[0]
        sizes = (self.patch_size, self.num_heads, self.depth)
        # The dicts of layers are in a plain list, so that torch does not register the layers twice.
        self._projections = list(filter(None, map(_projections, model.modules())))
        # Parameters by the last part of their names.
        special = {key.rpartition(".")[2]: x for key, x in model.named_parameters()}
        if (
            not all(isinstance(size, int) for size in sizes)
            or len(self._projections) != self.depth
            or not _CLS & special.keys()
        ):
            raise InputError(
                f"{name}: a {config.model_type} model, expected a vision transformer with one "
                "square patch_size, num_attention_heads, a CLS token, and in each of "
                "num_hidden_layers blocks the projections "
                f"{', '.join(map(' or '.join, _PROJECTIONS.values()))}"
            )
        self.image_size = nearest_multiple(image_size, self.patch_size)
        self.embed_dim = self._projections[0]["query"].in_features
        # Number of tokens that precede the patches.
        self._prefix = sum(
            special[key].numel() // self.embed_dim for key in _BEFORE_PATCHES if key in special
        )
        self._arguments = inspect.signature(model.forward).parameters
        self._try(name)

    def extract(
        self, images: Float[Tensor, "batch 3 height width"], layer: int, facet: Facet = "key"
    ) -> Tokens:
        """Compute block `layer`'s descriptors, the CLS attention and the CLS output.

        Register and distillation tokens are removed. Keys and queries are taken before any rotary
        position embedding, so that they do not depend on the position.
        """
        grid = (images.shape[2] // self.patch_size, images.shape[3] // self.patch_size)
        options = {}
        # Models without this option always interpolate.
        if "interpolate_pos_encoding" in self._arguments:
            options["interpolate_pos_encoding"] = True
        # A masked autoencoder sorts the patches by noise. Rising noise keeps their order.
        if "noise" in self._arguments:
            noise = torch.arange(grid[0] * grid[1], device=images.device).float()
            options["noise"] = noise.expand(len(images), -1)

        # The hook records the output of the facet's layer. "token" is no layer's output: its hook
        # is registered on a layer that is never called.
        projected: list[Tensor] = []
        layer_of_facet = self._projections[layer].get(facet, nn.Identity())
        hook = layer_of_facet.register_forward_hook(
            lambda module, inputs, output: projected.append(output)
        )
        try:
            output = self.vit(
                pixel_values=images, output_attentions=True, output_hidden_states=True, **options
            )
        finally:
            hook.remove()
        descriptors = output.hidden_states[layer + 1] if facet == "token" else projected[0]
        attention = output.attentions[-1][:, :, 0]  # from CLS: (batch, heads, tokens)
        return Tokens(
            descriptors[:, self._prefix :],
            attention[..., self._prefix :],
            output.last_hidden_state[:, 0],
            grid,
        )

    def _try(self, name: str) -> None:
        """Run one forward pass, so that an unsuitable model is refused when it is loaded."""
        try:
            with torch.inference_mode():
                tokens = self.extract(torch.zeros(1, 3, self.image_size, self.image_size), 0)
            rows, columns = tokens.grid
            if tokens.keys.shape[1] != rows * columns:
                raise ValueError(
                    f"{tokens.keys.shape[1]} tokens without {', '.join(_BEFORE_PATCHES)}"
                )
        except Exception as error:  # any model may be given, which may raise any exception
            raise InputError(
                f"{name}: {type(self.vit).__name__} does not run on {self.image_size} x "
                f"{self.image_size} pixels with one token per patch of {self.patch_size} x "
                f"{self.patch_size} ({one_line(error)})"
            ) from error


def load_huggingface(config: BackboneConfig, device: str | torch.device | None) -> Backbone:
    """Load the backbone of "hf:NAME": a folder in Hugging Face's format, or a model of the hub."""
    model, (mean, std) = _load_model(config.name, config.image_size)
    # A folder is named without its parents, so that results do not depend on where it lies.
    folder = Path(config.name.removeprefix(PREFIX)).expanduser()
    label = PREFIX + folder.resolve().name if os.path.isdir(folder) else config.name
    # Three quarters of the depth, as block 9 is of DINO's 12 blocks.
    layer = 3 * model.depth // 4 if config.layer is None else config.layer
    # One image at a time, because transformers returns the attention of all blocks.
    return Backbone(
        model,
        label,
        layer,
        range(model.num_heads),
        device,
        batch_size=1,
        facet=config.facet,
        mean=mean,
        std=std,
    )


def _load_model(name: str, image_size: int | None) -> tuple[HuggingFaceViT, Normalisation]:
    """Load the network of "hf:NAME", and the normalisation of its images."""
    # transformers is imported after this call, which raises InputError if the package is missing.
    folder = model_folder(name)
    from transformers import AutoConfig, AutoModel

    local = {"local_files_only": True, "trust_remote_code": False}
    try:
        config = AutoConfig.from_pretrained(folder, **local)
        # CLIP and similar models have a text encoder, too: only the image encoder is used.
        vision = getattr(config, "vision_config", config)
        if hasattr(vision, "mask_ratio"):
            vision.mask_ratio = 0.0  # a masked autoencoder must see the whole image
        with _quiet():
            model, report = AutoModel.from_pretrained(
                folder,
                config=config,
                use_safetensors=True,
                attn_implementation="eager",
                output_loading_info=True,
                dtype=torch.float32,
                **local,
            )
        normalisation = _normalisation(folder)
        # transformers initialises missing weights randomly. Only weights that the method does not
        # use may be missing.
        missing = sorted(
            key for key in report["missing_keys"] if "pooler" not in key and "mask_token" not in key
        )
        if missing:
            raise ValueError(f"{len(missing)} weights are not in the file, first {missing[0]}")
    # Damaged JSON, unknown types, wrong fields or shapes: no common base class.
    except Exception as error:
        raise InputError(
            f"{name}: cannot be loaded by the package transformers ({one_line(error)})"
        ) from error
    for key, weight in model.named_parameters():
        if key in report["missing_keys"]:
            # With random values, the backbone would have another identity at every start.
            weight.data.zero_()
    model = getattr(model, "vision_model", model).eval()
    return HuggingFaceViT(
        model, vision, IMAGE_SIZE if image_size is None else image_size, name
    ), normalisation


def model_folder(name: str) -> Path:
    """Return the folder of "hf:NAME": NAME itself, or the hub's cache folder of the model NAME.

    Only files that are not in the cache are downloaded, so that a model used before works without a
    network.
    """
    wanted = name.removeprefix(PREFIX).strip()
    folder = Path(wanted).expanduser()
    try:
        import transformers  # noqa: F401  raises ImportError before a download
        from huggingface_hub import snapshot_download
        from huggingface_hub.errors import LocalEntryNotFoundError

        if not wanted or not os.path.isdir(folder):  # isdir is False for a name that is too long
            with suppress(LocalEntryNotFoundError):
                folder = Path(
                    snapshot_download(wanted, allow_patterns=FILES, local_files_only=True)
                )
            if not _has_weights(folder):
                folder = Path(snapshot_download(wanted, allow_patterns=FILES))
    except ImportError as error:
        raise InputError(
            f"{name}: needs the package transformers: pip install transformers "
            f"huggingface-hub ({one_line(error)})"
        ) from error
    # The hub's client says what is wrong: no such model, no permission, or no network.
    except Exception as error:
        raise InputError(
            f"{name}: neither a folder nor a model OWNER/MODEL that the Hugging Face hub "
            f"gives ({one_line(error)})"
        ) from error
    if not (folder / CONFIG).is_file() or not _has_weights(folder):
        raise InputError(
            f"{name}: {folder} has no {CONFIG} or no {WEIGHTS[0]} (weights in other formats "
            "are not read)"
        )
    return folder


def _has_weights(folder: Path) -> bool:
    """Tell whether a folder has weights in safetensors format."""
    return any((folder / file).is_file() for file in WEIGHTS)


def _projections(attention: nn.Module) -> dict[str, nn.Linear]:
    """Return the linear layers of a module by facet; {} if it lacks one of the three."""
    layers = {}
    for facet, names in _PROJECTIONS.items():
        for name in names:
            layer = getattr(attention, name, None)
            if isinstance(layer, nn.Linear):
                layers[facet] = layer
    return layers if len(layers) == len(_PROJECTIONS) else {}


def _normalisation(folder: Path) -> Normalisation:
    """Return the image processor's mean and standard deviation, ImageNet's if it has none."""
    from transformers import ImageProcessingMixin

    if not any((folder / file).is_file() for file in PROCESSORS):
        return IMAGENET_MEAN, IMAGENET_STD
    settings, _ = ImageProcessingMixin.get_image_processor_dict(folder, local_files_only=True)
    if settings.get("do_normalize") is False:
        return [0.0] * 3, [1.0] * 3
    mean = settings.get("image_mean")
    std = settings.get("image_std")
    if mean is None or std is None:
        return IMAGENET_MEAN, IMAGENET_STD
    if not len(mean) == len(std) == 3 or not min(std) > 0:
        raise ValueError(
            f"image_mean {mean} and image_std {std}, expected three numbers each, image_std "
            "positive"
        )
    return mean, std


@contextmanager
def _quiet():
    """Hide transformers' progress bars and its report of unused weights."""
    from transformers.utils import logging

    verbosity = logging.get_verbosity()
    bars = logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(verbosity)
        if bars:
            logging.enable_progress_bar()
