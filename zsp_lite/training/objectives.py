"""What the backbone is asked for: correspondence on one surface, geometry per patch, attention on the object.

All three use only what a renderer, or structure from motion, knows about ONE object at a time. No loss compares two
objects; none sees a category or a pose.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor


def correspondence_loss(
    descriptors: Float[Tensor, "crops n dim"], surface: Float[Tensor, "crops n 3"], objects: int,
    radius: float, temperature: float, queries: int, generator: torch.Generator,
) -> tuple[Tensor, float]:  # fmt: skip
    """InfoNCE between the views of each object, with soft targets by distance on its surface.

    A query patch must find, among the patches of the object's other views, those within about `radius` (object
    units) of its own surface point. Descriptors are unit vectors. Returns the loss, as the divergence from the soft
    target so that 0 is perfect, and the share of queries whose nearest descriptor is a true neighbour.
    """
    crops, n, dim = descriptors.shape
    views = crops // objects
    z = descriptors.reshape(objects, views * n, dim)
    points = surface.reshape(objects, views * n, 3)
    view = torch.arange(views, device=z.device).repeat_interleave(n)
    losses, hits = [], []
    for k in range(objects):
        on_object = (~points[k, :, 0].isnan()).nonzero()[:, 0]
        query = on_object[torch.randperm(len(on_object), generator=generator)[:queries].to(on_object.device)]
        if len(query) < 20:
            continue
        same_view = view[query][:, None] == view[None]
        distance = torch.cdist(points[k, query], points[k].nan_to_num(nan=99.0))
        target = torch.exp(-distance.square() / (2 * radius**2)).masked_fill(same_view, 0)
        seen_again = target.amax(1) > 0.5
        if seen_again.sum() < 5:
            continue
        target, query = target[seen_again], query[seen_again]
        target = target * (target > 0.05)
        target = target / target.sum(1, keepdim=True)
        logits = (z[k, query] @ z[k].T / temperature).masked_fill(same_view[seen_again], -1e4)
        divergence = F.kl_div(logits.log_softmax(1), target, reduction="batchmean")
        losses.append(divergence)
        hits.append((target.gather(1, logits.argmax(1, keepdim=True)) > 0).float().mean())
    if not losses:
        return descriptors.sum() * 0, 0.0
    return torch.stack(losses).mean(), torch.stack(hits).mean().item()


def view_loss(
    descriptors: Float[Tensor, "crops n dim"], on_object: Bool[Tensor, "crops n"], objects: int, temperature: float
) -> tuple[Tensor, float]:
    """Which of the object's other views looks from the same side? Cross-entropy over the best-view score.

    Views come in pairs (2k, 2k + 1). The score of two views is what the method chooses the best view by, in a form
    with gradients: the mean over one view's object patches of the highest similarity in the other. Opposite sides,
    front and back, are among the wrong answers. Returns the loss and the share of views whose partner scores highest.
    """
    crops, n, dim = descriptors.shape
    views = crops // objects
    z, on = descriptors.reshape(objects, views * n, dim), on_object.reshape(objects, views, n)
    product = (z @ z.transpose(1, 2)).view(objects, views, n, views, n)
    highest = product.masked_fill(~on[:, None, None], -1).amax(-1)  # (objects, views, n, views)
    score = (highest * on[..., None]).sum(2) / on.sum(2).clamp_min(1)[..., None]
    score = (score + score.transpose(1, 2)) / 2
    itself = torch.eye(views, dtype=torch.bool, device=z.device)
    logits = (score / temperature).masked_fill(itself, -1e4).flatten(0, 1)
    partner = (torch.arange(views, device=z.device) ^ 1).repeat(objects)
    seen = (on.sum(2) > 3).flatten()
    loss = F.cross_entropy(logits[seen], partner[seen]) if seen.any() else descriptors.sum() * 0
    hits = (logits.argmax(1) == partner)[seen].float().mean().item() if seen.any() else 0.0
    return loss, hits


def geometry_loss(
    prediction: Float[Tensor, "crops n 5"], geometry: Float[Tensor, "crops n 4"], on_object: Bool[Tensor, "crops n"]
) -> Tensor:
    """Read normals, relative depth (channels 0 to 3) and foreground (channel 4) from each patch token."""
    inside = on_object.float()
    foreground = F.binary_cross_entropy_with_logits(prediction[..., 4], inside)
    error = F.smooth_l1_loss(prediction[..., :4], geometry, beta=0.3, reduction="none").mean(-1)
    return foreground + 2 * (error * inside).sum() / inside.sum().clamp_min(1)


def attention_loss(
    cls_logits: Float[Tensor, "crops heads tokens"], coverage: Float[Tensor, "crops n"]
) -> tuple[Tensor, float]:
    """Ask the CLS attention, averaged over heads, to spread evenly over the object and leave the rest.

    cls_logits holds 1 + n columns, the CLS token first.

    Divergence between the normalised mask and the attention over patches, and a cross-entropy that separates the two
    sides at 0.12 of the object's mean attention. This is supervision by rendered masks. Returns the loss and the mean
    IoU of (attention, min-max scaled) > 0.05 with the mask, the paper's foreground rule.
    """
    attention = cls_logits.softmax(-1)[..., 1:].mean(1)
    attention = attention / attention.sum(1, keepdim=True)
    visible = coverage.sum(1) > 2
    attention, coverage = attention[visible].clamp_min(1e-8), coverage[visible]
    target = coverage / coverage.sum(1, keepdim=True)
    spread = F.kl_div(attention.log(), target, reduction="batchmean")
    level = (attention * coverage).sum(1, keepdim=True) / coverage.sum(1, keepdim=True)
    side = F.binary_cross_entropy_with_logits(attention.log() - (0.12 * level.detach()).log(), coverage)
    with torch.no_grad():
        low, high = attention.amin(1, keepdim=True), attention.amax(1, keepdim=True)
        found, truth = (attention - low) / (high - low + 1e-12) > 0.05, coverage > 0.25
        iou = ((found & truth).sum(1) / (found | truth).sum(1).clamp_min(1)).mean().item()
    return spread + 0.25 * side, iou
