"""Training losses: correspondence, choice of the view, geometry per patch, and attention on the object.

The losses use ground truth of the renderer for the views of one object: corresponding surface points and views from the
same side. The object's proportions differ from view to view. No loss compares two objects or uses category names.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from zsp_lite.features import log_bin


def correspondence_loss(
    descriptors: Float[Tensor, "crops n dim"], surface: Float[Tensor, "crops n 3"], objects: int,
    radius: float, temperature: float, queries: int, generator: torch.Generator,
) -> tuple[Tensor, float]:  # fmt: skip
    """Compute InfoNCE between the views of each object, with soft targets by distance on its surface.

    The target of a query patch is a distribution over the patches of the object's other views. It is a Gaussian of the
    distance between the surface points, and 0 beyond 2.4 standard deviations.

    Args:
        descriptors: Unit vectors, ordered by object and view.
        surface: Surface point of each patch in object coordinates, NaN on the background.
        objects: Number of objects.
        radius: Standard deviation of the Gaussian, in object units.
        temperature: Temperature of the softmax over similarities.
        queries: Largest number of query patches per object.
        generator: Source of the random queries.

    Returns:
        The loss, as the divergence from the targets, so that 0 is its minimum; and the fraction of queries whose
        nearest descriptor has a non-zero target.
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
    keys: Float[Tensor, "crops h w dim"], on_object: Bool[Tensor, "crops n"], objects: int, temperature: float,
    queries: int, generator: torch.Generator, log_binned: bool = True,
) -> tuple[Tensor, float]:  # fmt: skip
    """Compute the cross-entropy of selecting, among the views of the other instance, the one from the same side.

    Views 2k and 2k + 1 show the same side, of two instances of the object: the even views are compared with the odd
    ones. Views of the opposite side are among the negatives. The score of two views
    is a differentiable form of the best-view score: the mean over patches of one view of their highest similarity in
    the other view, made symmetric.

    Args:
        keys: Keys, ordered by object and view.
        on_object: Patches on the object.
        objects: Number of objects.
        temperature: Temperature of the softmax over scores.
        queries: Largest number of patches per view.
        generator: Source of the random patches.
        log_binned: Compare log-binned descriptors; False compares the keys.

    Returns:
        The loss, and the fraction of views whose partner has the highest score.
    """
    crops = len(keys)
    views = crops // objects
    partner = torch.arange(views, device=keys.device) ^ 1
    scores = []
    for k in range(objects):
        part = slice(k * views, (k + 1) * views)
        on = on_object[part]
        described = log_bin(keys[part]) if log_binned else keys[part]
        z = F.normalize(described.flatten(1, 2)[on], dim=1)
        counts = on.sum(1).tolist()
        chosen = [torch.randperm(n, generator=generator)[:queries] for n in counts]
        starts = [sum(counts[:v]) for v in range(views)]
        query = torch.cat([rows + start for rows, start in zip(chosen, starts, strict=True)]).to(z.device)
        similar = (z[query] @ z.T).split(counts, 1)
        highest = torch.stack([s.amax(1) if s.shape[1] else s.new_full(s.shape[:1], -1.0) for s in similar], 1)
        taken = highest.split([len(rows) for rows in chosen])
        score = torch.stack([rows.mean(0) if len(rows) else rows.new_full((views,), -1.0) for rows in taken])
        scores.append((score + score.T) / 2)
    seen = on_object.view(objects, views, -1).sum(2) > 3
    parity = torch.arange(views, device=keys.device) % 2
    excluded = (parity[:, None] == parity) | ~seen[:, None]
    valid = seen & seen[:, partner]
    if not valid.any():
        return keys.sum() * 0, 0.0
    logits = (torch.stack(scores) / temperature).masked_fill(excluded, -1e4)[valid]
    labels = partner.expand(objects, -1)[valid]
    return F.cross_entropy(logits, labels), (logits.argmax(1) == labels).float().mean().item()


def geometry_loss(
    prediction: Float[Tensor, "crops n 5"], geometry: Float[Tensor, "crops n 4"], on_object: Bool[Tensor, "crops n"]
) -> Tensor:
    """Compute the loss of predicted normals and relative depth (channels 0 to 3) and foreground logit (channel 4)."""
    inside = on_object.float()
    foreground = F.binary_cross_entropy_with_logits(prediction[..., 4], inside)
    error = F.smooth_l1_loss(prediction[..., :4], geometry, beta=0.3, reduction="none").mean(-1)
    return foreground + 2 * (error * inside).sum() / inside.sum().clamp_min(1)


def attention_loss(
    cls_logits: Float[Tensor, "crops heads tokens"], coverage: Float[Tensor, "crops n"]
) -> tuple[Tensor, float]:
    """Compute the loss of the CLS attention, averaged over heads, against the rendered mask.

    The target is uniform on the object and zero elsewhere. The loss is the divergence between the normalised mask and
    the attention over patches, plus a cross-entropy that separates object and background at 0.12 times the mean
    attention on the object.

    Args:
        cls_logits: Attention logits of the CLS token, CLS first.
        coverage: Fraction of each patch that the object covers.

    Returns:
        The loss, and the mean IoU of the mask with the patches of min-max normalised attention above 0.05.
    """
    attention = cls_logits.softmax(-1)[..., 1:].mean(1)
    attention = attention / attention.sum(1, keepdim=True)
    visible = coverage.sum(1) > 2
    if not visible.any():
        return cls_logits.sum() * 0, 0.0
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
