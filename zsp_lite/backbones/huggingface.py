"""Vision transformers in Hugging Face's format: DINOv2, DINOv3, ViT, DeiT, CLIP's and what is built like them.

No table of models: the blocks are found by the names of their query, key and value projections, on which hooks
stand during a forward pass, and the CLS token's attention is read where every model hands queries and keys over.
Needs the package transformers (`pip install 'zsp-lite[transformers]'`), imported on first use.
"""

import inspect
import json
from contextlib import contextmanager, suppress
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from zsp_lite.backbones.vit import Tokens
from zsp_lite.errors import InputError

PREFIX = "hf:"
IMAGE_SIZE = 224  # pixels, the paper's
# The only files that are fetched or read: weights as safetensors, no pickles, no code.
FILES = (
    "config.json", "preprocessor_config.json", "processor_config.json", "model*.safetensors",
    "model.safetensors.index.json",
)  # fmt: skip
_ATTENTION = "zsp_lite_cls"  # the name under which transformers knows `_attend`
_ROWS = "zsp_lite_cls_rows"  # an attention module's list to which `_attend` adds
_PROJECTIONS = (("q_proj", "k_proj", "v_proj"), ("query", "key", "value"))
_CLS = ("cls_token", "class_token", "class_embedding")
_BEFORE_PATCHES = (*_CLS, "register_tokens", "distillation_token")


class HuggingFaceViT(nn.Module):
    """A Hugging Face model with the attributes and the `extract` of `vit.VisionTransformer`.

    image_size: side in pixels at which images will come. mean, std: of RGB in [0, 1], those to normalise by, or None
    where the model does not say. Raises InputError where the model has no CLS token, no stack of blocks with query,
    key and value projections, or does not run at that size.
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
        # In plain lists: the modules are the model's, and belong to it alone.
        self._stack, self._attention = list(stack), attention
        self.embed_dim = _projections(attention[0])["query"].in_features
        self._prefix = _prefix_length(model, self.embed_dim, name)
        self._arguments = inspect.signature(model.forward).parameters.keys()
        self._probe()

    def extract(self, images: Float[Tensor, "batch 3 height width"], block: int, facet: str = "key") -> Tokens:
        """The facet (see `facets`) of block `block` (from 0), last CLS attention and CLS output, in one forward.

        Register and distillation tokens are dropped. Keys and queries are those before any rotary embedding, which
        would mix position into them; the attention is the model's own. Of several CLS tokens the first counts.
        """
        found = []
        chosen = self._stack[block] if facet == "token" else _projections(self._attention[block])[facet]
        hook = chosen.register_forward_hook(lambda module, inputs, output: found.append(output))
        rows: list[Tensor] = []
        setattr(self._attention[-1], _ROWS, rows)
        try:
            cls = self.vit(pixel_values=images, **self._options(images))[0][:, 0]
        finally:
            hook.remove()
            delattr(self._attention[-1], _ROWS)
        if not rows:
            raise InputError(f"{self.name}: {type(self.vit).__name__} attends past transformers' attention interface")
        described = found[0] if torch.is_tensor(found[0]) else found[0][0]
        patches = slice(self._prefix, None)
        return Tokens(described[:, patches], rows[0][:, :, patches], cls, self._grid(images))

    def _options(self, images: Tensor) -> dict:
        options = {}
        if "interpolate_pos_encoding" in self._arguments:  # others do so unasked
            options["interpolate_pos_encoding"] = True
        if "noise" in self._arguments:  # of a masked autoencoder, which sorts patches by it, then drops the last ones
            rows, columns = self._grid(images)
            options["noise"] = torch.arange(rows * columns, device=images.device).float().expand(len(images), -1)
        return options

    def _grid(self, images: Tensor) -> tuple[int, int]:
        return images.shape[2] // self.patch_size, images.shape[3] // self.patch_size

    def _probe(self) -> None:
        """One forward pass, so that what does not fit shows now and not at the first image."""
        images = torch.zeros(1, 3, self.image_size, self.image_size)
        rows, columns = self._grid(images)
        try:
            with torch.inference_mode():
                tokens = self.extract(images, 0)
        except InputError:
            raise
        except Exception as error:
            # Of others' models each fails in its own way; all that matters here is that this one does not run.
            raise InputError(
                f"{self.name}: {type(self.vit).__name__} does not run on {self.image_size} x {self.image_size} pixels "
                f"({_one_line(error)})"
            ) from error
        if tokens.keys.shape[1] != rows * columns or tokens.attention.shape[1:] != (self.num_heads, rows * columns):
            raise InputError(
                f"{self.name}: {type(self.vit).__name__} has {tokens.keys.shape[1]} tokens besides the known special "
                f"ones ({', '.join(_BEFORE_PATCHES)}), expected one per patch, {rows} x {columns}"
            )


def load_huggingface(name: str, image_size: int | None = None) -> HuggingFaceViT:
    """The model of "hf:NAME": a folder in Hugging Face's format, or a model of the hub (see `model_folder`).

    image_size: pixels, default 224, taken to the nearest multiple of the patch size. Raises InputError where
    transformers or the model is missing, or the model is not a vision transformer with a CLS token, all weights there.
    """
    AutoConfig, AutoModel = _transformers(name)
    folder = model_folder(name)
    try:
        config = AutoConfig.from_pretrained(folder, local_files_only=True, trust_remote_code=False)
    except Exception as error:  # damaged JSON, unknown types, wrong fields: no common class
        raise InputError(
            f"{name}: config.json is not that of a model known to transformers ({_one_line(error)})"
        ) from error
    vision = getattr(config, "vision_config", config)  # CLIP and the like: the image's half
    patch_size, _ = _sizes(vision, name)
    if hasattr(vision, "mask_ratio"):
        vision.mask_ratio = 0.0  # a masked autoencoder shall see the whole image
    try:
        with _quiet():
            model, found = AutoModel.from_pretrained(
                folder, config=config, local_files_only=True, trust_remote_code=False, use_safetensors=True,
                attn_implementation=_ATTENTION, output_loading_info=True,
            )  # fmt: skip
    except Exception as error:  # as above
        raise InputError(f"{name}: cannot be loaded ({_one_line(error)})") from error
    # What the method never reads may be missing; anything else would be random numbers.
    missing = sorted(key for key in found["missing_keys"] if "pooler" not in key and "mask_token" not in key)
    if missing:
        raise InputError(f"{name}: {len(missing)} weights are not in the file, first {missing[0]}")
    made_up = found["missing_keys"]
    for key, weight in model.named_parameters():
        if key in made_up:
            weight.data.zero_()  # drawn at random, they would make every loading another backbone
    model = getattr(model, "vision_model", model).to(torch.float32).eval()
    size = nearest_multiple(IMAGE_SIZE if image_size is None else image_size, patch_size)
    return HuggingFaceViT(model, vision, size, *_normalisation(folder, name), name)


def model_folder(name: str) -> Path:
    """The folder of "hf:NAME": NAME itself where it is one, else the hub's files of that name in the hub's cache.

    Only what is not in the cache is fetched, so that without a network everything works that once worked with one.
    Raises InputError saying why there is none.
    """
    wanted = name.removeprefix(PREFIX).strip()
    if not wanted:
        raise InputError(f"{name}: expected a folder or a name of the hub's form OWNER/MODEL behind {PREFIX}")
    folder = Path(wanted).expanduser()
    if not folder.is_dir():
        folder = _from_hub(wanted, name)
    if not (folder / "config.json").is_file():
        raise InputError(f"{name}: {folder} has no config.json, expected a model in Hugging Face's format")
    if not _has_weights(folder):
        raise InputError(f"{name}: {folder} has no model.safetensors (weights are read from no other kind of file)")
    return folder


def _has_weights(folder: Path) -> bool:
    return any((folder / file).is_file() for file in ("model.safetensors", "model.safetensors.index.json"))


def nearest_multiple(size: int, of: int) -> int:
    """The multiple of `of`, at least one time it, that is nearest to size. Raises InputError for a size below 1."""
    if size < 1:
        raise InputError(f"image_size: expected at least 1 pixel, got {size}")
    return max(1, round(size / of)) * of


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
        raise InputError(f"{name}: no such folder, and no name of the hub's form OWNER/MODEL") from error
    except GatedRepoError as error:
        raise InputError(
            f"{name}: its owner wants a licence accepted; do so at https://huggingface.co/{wanted}, then hf auth login"
        ) from error
    except RepositoryNotFoundError as error:
        raise InputError(f"{name}: no such folder, and the Hugging Face hub has no such model to show") from error
    except LocalEntryNotFoundError as error:
        raise InputError(
            f"{name}: no such folder, not in the Hugging Face cache, and the hub cannot be reached; where there is a "
            f"network: zsp-lite weights fetch {name}"
        ) from error
    except Exception as error:  # what the hub's client meets on the way changes with its HTTP library
        raise InputError(f"{name}: cannot be fetched from the Hugging Face hub ({_one_line(error)})") from error


def _transformers(name: str):
    """transformers' two entry points, our attention function made known to it. InputError where it is missing."""
    try:
        from transformers import AttentionInterface, AutoConfig, AutoModel
    except ImportError as error:
        raise InputError(
            f"{name}: needs the package transformers: pip install 'zsp-lite[transformers]' ({_one_line(error)})"
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
    """transformers' fused attention; where asked to, the attention of the first token (CLS) to all is kept besides.

    That is one row of the attention matrix, (batch, heads, n); the matrix itself is never made. `attention_mask` is a
    bias to the logits.
    """
    from transformers import AttentionInterface

    if (rows := getattr(module, _ROWS, None)) is not None:
        with torch.autocast(query.device.type, enabled=False):
            scale = query.shape[-1] ** -0.5 if scaling is None else scaling
            logits = ((query[:, :, :1].float() * scale) @ key.float().transpose(-1, -2))[:, :, 0]
            rows.append((logits if attention_mask is None else logits + attention_mask[:, :, 0]).softmax(-1))
    return AttentionInterface()["sdpa"](module, query, key, value, attention_mask, scaling=scaling, **options)


def _sizes(config, name: str) -> tuple[int, int]:
    """(patch size, heads). InputError where the configuration is not that of a plain vision transformer."""
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


def _projections(attention: nn.Module) -> dict[str, nn.Module]:
    """Facet to the projection that makes it, where all three are the module's own; else nothing."""
    for names in _PROJECTIONS:
        if all(isinstance(getattr(attention, name, None), nn.Linear) for name in names):
            return dict(zip(("query", "key", "value"), (getattr(attention, name) for name in names)))
    return {}


def _blocks(model: nn.Module, depth: int, name: str) -> tuple[nn.ModuleList, list[nn.Module]]:
    """The stack of blocks and the attention module of each."""
    for stack in model.modules():
        if isinstance(stack, nn.ModuleList) and len(stack) == depth:
            found = [[module for module in block.modules() if _projections(module)] for block in stack]
            if all(len(modules) == 1 for modules in found):
                return stack, [modules[0] for modules in found]
    raise InputError(
        f"{name}: {type(model).__name__} is not a vision transformer that can be read, expected {depth} blocks, each "
        f"with projections {' or '.join(', '.join(names) for names in _PROJECTIONS)}"
    )


def _prefix_length(model: nn.Module, dim: int, name: str) -> int:
    """How many tokens stand before the patches."""
    special = {}
    for key, parameter in model.named_parameters():
        leaf = key.rpartition(".")[2]
        if leaf in _BEFORE_PATCHES:
            special[leaf] = parameter.numel() // dim
    if not special.keys() & set(_CLS):
        raise InputError(f"{name}: {type(model).__name__} has no CLS token, whose attention is the saliency")
    return sum(special.values())


def _normalisation(folder: Path, name: str) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
    """Mean and standard deviation that the folder's image processor takes, None where it does not say."""
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
    """The object in a JSON file, an empty one where there is no file."""
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_bytes())
    except ValueError as error:
        raise InputError(f"{name}: {path.name} is not JSON ({_one_line(error)})") from error
    if not isinstance(content, dict):
        raise InputError(f"{name}: {path.name} holds a {type(content).__name__}, expected an object")
    return content


@contextmanager
def _quiet():
    """No progress bar and no report of weights that are not needed while a model is loaded."""
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
