"""Vision transformers in Hugging Face's format: DINOv2, DINOv3, ViT, DeiT, CLIP's image encoder and similar models.

The code does not depend on the architecture: blocks are found by the names of their query, key and value projections,
forward hooks record the outputs of these, and the attention of the CLS token is computed in transformers' attention
interface, which all models call. Needs the package transformers (the extra `transformers`), which is
imported on first use.
"""

import inspect
import json
import os
from contextlib import contextmanager, suppress
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from zsp_lite.backbones.facets import Facet
from zsp_lite.backbones.vit import Tokens
from zsp_lite.errors import InputError, check_integer
from zsp_lite.io.files import file_size

PREFIX = "hf:"
IMAGE_SIZE = 224  # pixels, the paper's
MOST_PIXELS = 2048  # of a side; the time of attention grows with the fourth power of the side
# The only files that are downloaded or read: weights in safetensors format, no pickle files, no code.
FILES = (
    "config.json", "preprocessor_config.json", "processor_config.json", "model*.safetensors",
    "model.safetensors.index.json",
)  # fmt: skip
_ATTENTION = "zsp_lite_cls"  # the name by which `_attend` is registered in transformers
_ROWS = "zsp_lite_cls_rows"  # attribute of an attention module: list to which `_attend` appends
_PROJECTIONS = (("q_proj", "k_proj", "v_proj"), ("query", "key", "value"))
_CLS = ("cls_token", "class_token", "class_embedding")
_BEFORE_PATCHES = (*_CLS, "register_tokens", "distillation_token")


class HuggingFaceViT(nn.Module):
    """Adapter of a Hugging Face model with the attributes and the `extract` of `vit.VisionTransformer`.

    Args:
        model: Vision model.
        config: Its configuration.
        image_size: Side in pixels of the images.
        mean, std: Normalisation of RGB values in [0, 1]; None if unknown.
        name: Name for error messages.

    Raises:
        InputError: If the model has no CLS token, no stack of blocks with query, key and value projections, or does not
            run at that image size.
    """

    def __init__(
        self,
        model: nn.Module,
        config,
        image_size: int,
        mean: tuple[float, ...] | None = None,
        std: tuple[float, ...] | None = None,
        name: str = "model",
    ):
        super().__init__()
        self.vit, self.name, self.image_size, self.mean, self.std = model, name, image_size, mean, std
        self.patch_size, self.num_heads = _sizes(config, name)
        stack, attention = _blocks(model, config.num_hidden_layers, name)
        self.depth = len(stack)
        # In plain lists, so that the modules are not registered a second time.
        self._stack, self._attention = list(stack), attention
        self.embed_dim = _projections(attention[0])["query"].in_features
        self._prefix = _prefix_length(model, self.embed_dim, name)
        self._arguments = inspect.signature(model.forward).parameters.keys()
        self._probe()

    def extract(self, images: Float[Tensor, "batch 3 height width"], layer: int, facet: Facet = "key") -> Tokens:
        """Compute patch descriptors, CLS attention and CLS output in one forward pass.

        Register and distillation tokens are removed. Keys and queries are taken before any rotary position embedding,
        so that they do not depend on the position.

        Args:
            images: Normalised RGB images; height and width are multiples of the patch size.
            layer: Block that describes the patches, counted from 0.
            facet: Activation of that block used as descriptor (`Facet`).
        """
        outputs = []
        module = self._stack[layer] if facet == "token" else _projections(self._attention[layer])[facet]
        hook = module.register_forward_hook(lambda module, inputs, output: outputs.append(output))
        rows: list[Tensor] = []
        setattr(self._attention[-1], _ROWS, rows)
        try:
            cls = self.vit(pixel_values=images, **self._options(images))[0][:, 0]
        finally:
            hook.remove()
            delattr(self._attention[-1], _ROWS)
        if not rows:
            raise InputError(f"{self.name}: {type(self.vit).__name__} does not use transformers' attention interface")
        descriptors = outputs[0] if torch.is_tensor(outputs[0]) else outputs[0][0]
        patches = slice(self._prefix, None)
        return Tokens(descriptors[:, patches], rows[0][:, :, patches], cls, self._grid(images))

    def _options(self, images: Tensor) -> dict:
        options = {}
        if "interpolate_pos_encoding" in self._arguments:  # models without this option always interpolate
            options["interpolate_pos_encoding"] = True
        if "noise" in self._arguments:  # a masked autoencoder orders the patches by it: keep their order
            rows, columns = self._grid(images)
            options["noise"] = torch.arange(rows * columns, device=images.device).float().expand(len(images), -1)
        return options

    def _grid(self, images: Tensor) -> tuple[int, int]:
        return images.shape[2] // self.patch_size, images.shape[3] // self.patch_size

    def _probe(self) -> None:
        """Run one forward pass, so that an unsuitable model is refused when it is loaded."""
        images = torch.zeros(1, 3, self.image_size, self.image_size)
        rows, columns = self._grid(images)
        try:
            with torch.inference_mode():
                tokens = self.extract(images, 0)
        except InputError:
            raise
        except Exception as error:
            # Any model may be given: any exception means that it is unsuitable.
            raise InputError(
                f"{self.name}: {type(self.vit).__name__} does not run on {self.image_size} x {self.image_size} pixels "
                f"({_one_line(error)})"
            ) from error
        if tokens.keys.shape[1] != rows * columns or tokens.attention.shape[1:] != (self.num_heads, rows * columns):
            raise InputError(
                f"{self.name}: {type(self.vit).__name__} has {tokens.keys.shape[1]} tokens without the known special "
                f"ones ({', '.join(_BEFORE_PATCHES)}), expected one per patch, {rows} x {columns}"
            )


def load_huggingface(name: str, image_size: int | None = None) -> HuggingFaceViT:
    """Load the model of "hf:NAME".

    Args:
        name: "hf:" and a folder in Hugging Face's format or the name of a model on the hub.
        image_size: Side in pixels, rounded to a multiple of the patch size. Default: 224.

    Raises:
        InputError: If transformers or the model is missing, weights are missing, or the model is not a vision
            transformer with a CLS token.
    """
    AutoConfig, AutoModel = _transformers(name)
    folder = model_folder(name)
    try:
        config = AutoConfig.from_pretrained(folder, local_files_only=True, trust_remote_code=False)
    except Exception as error:  # damaged JSON, unknown types, wrong fields: no common base class
        raise InputError(
            f"{name}: config.json does not describe a model known to transformers ({_one_line(error)})"
        ) from error
    vision = getattr(config, "vision_config", config)  # CLIP and similar models: the image encoder
    patch_size, _ = _sizes(vision, name)
    _check_bytes(vision, folder, name)
    if hasattr(vision, "mask_ratio"):
        vision.mask_ratio = 0.0  # a masked autoencoder must see the whole image
    try:
        with _quiet():
            model, report = AutoModel.from_pretrained(
                folder, config=config, local_files_only=True, trust_remote_code=False, use_safetensors=True,
                attn_implementation=_ATTENTION, output_loading_info=True,
            )  # fmt: skip
    except Exception as error:  # as above
        raise InputError(f"{name}: cannot be loaded ({_one_line(error)})") from error
    # transformers initialises missing weights randomly. Only weights that the method does not use may be missing.
    missing = sorted(key for key in report["missing_keys"] if "pooler" not in key and "mask_token" not in key)
    if missing:
        raise InputError(f"{name}: {len(missing)} weights are not in the file, first {missing[0]}")
    for key, weight in model.named_parameters():
        if key in report["missing_keys"]:
            weight.data.zero_()  # random values would give the backbone another identity at every start
    model = getattr(model, "vision_model", model).to(torch.float32).eval()
    size = nearest_multiple(IMAGE_SIZE if image_size is None else image_size, patch_size)
    return HuggingFaceViT(model, vision, size, *_normalisation(folder, name), name)


def model_folder(name: str) -> Path:
    """Return the folder of "hf:NAME": NAME if it is a folder, else the hub's cache folder of the model NAME.

    Only files that are not in the cache are downloaded, so that a model used before works without a network.

    Raises:
        InputError: If there is no such model; the message says why.
    """
    wanted = name.removeprefix(PREFIX).strip()
    if not wanted:
        raise InputError(f"{name}: expected a folder or a hub name OWNER/MODEL after {PREFIX}")
    folder = Path(wanted).expanduser()
    if not os.path.isdir(folder):  # False for a name that is too long, where Path.is_dir raises
        folder = _from_hub(wanted, name)
    if not (folder / "config.json").is_file():
        raise InputError(f"{name}: {folder} has no config.json, expected a model in Hugging Face's format")
    if not _has_weights(folder):
        raise InputError(f"{name}: {folder} has no model.safetensors (weights in other formats are not read)")
    return folder


def _has_weights(folder: Path) -> bool:
    return any((folder / file).is_file() for file in ("model.safetensors", "model.safetensors.index.json"))


def nearest_multiple(size: int, patch_size: int) -> int:
    """Round `size` to a positive multiple of `patch_size`. Raises InputError for a size below 1 or above 2048."""
    check_integer("image_size", size, 1, MOST_PIXELS)
    return max(1, round(size / patch_size)) * patch_size


def _from_hub(wanted: str, name: str) -> Path:
    _transformers(name)
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import (
        GatedRepoError,
        HFValidationError,
        LocalEntryNotFoundError,
        RepositoryNotFoundError,
    )

    try:
        with suppress(LocalEntryNotFoundError):
            folder = Path(snapshot_download(wanted, allow_patterns=FILES, local_files_only=True))
            if _has_weights(folder):
                return folder
        return Path(snapshot_download(wanted, allow_patterns=FILES))
    except HFValidationError as error:
        raise InputError(f"{name}: no such folder, and not a hub name OWNER/MODEL") from error
    except GatedRepoError as error:
        raise InputError(
            f"{name}: its licence must be accepted at https://huggingface.co/{wanted}; then run hf auth login"
        ) from error
    except RepositoryNotFoundError as error:
        raise InputError(f"{name}: no such folder, and no such public model on the Hugging Face hub") from error
    except LocalEntryNotFoundError as error:
        raise InputError(
            f"{name}: no such folder, not in the Hugging Face cache, and the hub cannot be reached; with a network "
            f"connection, run zsp-lite weights fetch {name}"
        ) from error
    except Exception as error:  # the exceptions of the hub's client depend on its HTTP library
        raise InputError(f"{name}: cannot be downloaded from the Hugging Face hub ({_one_line(error)})") from error


def _transformers(name: str):
    """Import transformers and register `_attend`. Raises InputError if it is not installed."""
    try:
        from transformers import AttentionInterface, AutoConfig, AutoModel
    except ImportError as error:
        raise InputError(
            f"{name}: needs the package transformers: pip install transformers huggingface-hub ({_one_line(error)})"
        ) from error
    AttentionInterface.register(_ATTENTION, _attend)
    return AutoConfig, AutoModel


def _attend(
    module: nn.Module,
    query: Float[Tensor, "batch heads n head_dim"],
    key: Float[Tensor, "batch heads n head_dim"],
    value: Float[Tensor, "batch heads n head_dim"],
    attention_mask: Tensor | None = None,
    scaling: float | None = None,
    **options,
) -> tuple[Tensor, None]:
    """Compute attention by transformers' fused function; on request also record the attention of the CLS token.

    The recorded attention is one row (batch, heads, n); the full attention matrix is never computed. `attention_mask`
    is added to the logits.
    """
    from transformers import AttentionInterface

    if (rows := getattr(module, _ROWS, None)) is not None:
        scale = query.shape[-1] ** -0.5 if scaling is None else scaling
        logits = ((query[:, :, :1] * scale) @ key.transpose(-1, -2))[:, :, 0]
        rows.append((logits if attention_mask is None else logits + attention_mask[:, :, 0]).softmax(-1))
    return AttentionInterface()["sdpa"](module, query, key, value, attention_mask, scaling=scaling, **options)


def _sizes(config, name: str) -> tuple[int, int]:
    """Return (patch size, number of heads). Raises InputError unless it is a plain vision transformer."""
    patch, heads = getattr(config, "patch_size", None), getattr(config, "num_attention_heads", None)
    if isinstance(patch, (list, tuple)) and len(set(patch)) == 1:
        patch = patch[0]
    if not all(isinstance(x, int) for x in (patch, heads, getattr(config, "num_hidden_layers", None))):
        raise InputError(
            f"{name}: a {config.model_type} model, expected a vision transformer (one square patch_size, "
            f"num_hidden_layers, num_attention_heads)"
        )
    if getattr(config, "num_channels", 3) != 3:
        raise InputError(f"{name}: takes {config.num_channels} channels, expected 3")
    return patch, heads


def _check_bytes(config, folder: Path, name: str) -> None:
    """Raise InputError if the matrices that a configuration describes would not fit into the files of weights."""
    size = sum(file_size(path, "weights") for path in folder.glob("model*.safetensors"))
    width, layers = getattr(config, "hidden_size", None), config.num_hidden_layers
    width = width if isinstance(width, int) else 1
    described = max(layers, 1) * width * max(4 * width, getattr(config, "intermediate_size", None) or 0)
    if described > size or min(width, layers) < 1:
        raise InputError(
            f"{name}: config.json describes {layers} layers of {width} channels, which do not fit into {size} bytes"
        )


def _projections(attention: nn.Module) -> dict[str, nn.Module]:
    """Return the linear layer of each facet if the module itself has all three, else an empty dict."""
    for names in _PROJECTIONS:
        if all(isinstance(getattr(attention, name, None), nn.Linear) for name in names):
            return dict(zip(("query", "key", "value"), (getattr(attention, name) for name in names)))
    return {}


def _blocks(model: nn.Module, depth: int, name: str) -> tuple[nn.ModuleList, list[nn.Module]]:
    """Return the stack of blocks and the attention module of each block."""
    for stack in model.modules():
        if isinstance(stack, nn.ModuleList) and len(stack) == depth:
            found = [[module for module in block.modules() if _projections(module)] for block in stack]
            if all(len(modules) == 1 for modules in found):
                return stack, [modules[0] for modules in found]
    raise InputError(
        f"{name}: {type(model).__name__} is not a supported vision transformer, expected {depth} blocks, each with "
        f"projections {' or '.join(', '.join(names) for names in _PROJECTIONS)}"
    )


def _prefix_length(model: nn.Module, dim: int, name: str) -> int:
    """Return the number of special tokens before the patch tokens."""
    special = {}
    for key, parameter in model.named_parameters():
        leaf = key.rpartition(".")[2]
        if leaf in _BEFORE_PATCHES:
            special[leaf] = parameter.numel() // dim
    if not special.keys() & set(_CLS):
        raise InputError(f"{name}: {type(model).__name__} has no CLS token, whose attention is the saliency")
    return sum(special.values())


def _normalisation(folder: Path, name: str) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
    """Return mean and standard deviation from the image processor's settings, None if they are not there."""
    settings = _read_json(folder / "processor_config.json", name).get("image_processor")
    settings = settings or _read_json(folder / "preprocessor_config.json", name)
    if settings.get("do_normalize") is False:
        return (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
    mean, std = (settings.get(key) for key in ("image_mean", "image_std"))
    if mean is None or std is None:
        return None, None
    if not all(isinstance(x, list) and len(x) == 3 for x in (mean, std)) or not min(std) > 0:
        raise InputError(f"{name}: image_mean {mean} and image_std {std}, expected three numbers each, std positive")
    return tuple(map(float, mean)), tuple(map(float, std))


def _read_json(path: Path, name: str) -> dict:
    """Read a JSON object; empty if there is no file."""
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_bytes())
    except ValueError as error:
        raise InputError(f"{name}: {path.name} is not JSON ({_one_line(error)})") from error
    if not isinstance(content, dict):
        raise InputError(f"{name}: {path.name} contains a {type(content).__name__}, expected an object")
    return content


@contextmanager
def _quiet():
    """Hide transformers' progress bars and its report of unused weights."""
    from transformers.utils import logging

    verbosity, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity_error()
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(verbosity)
        if bars:
            logging.enable_progress_bar()


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
