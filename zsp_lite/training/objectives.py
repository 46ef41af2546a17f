"""What the backbone is asked for: correspondence on one surface, geometry per patch, attention on the object.

All four use what a renderer knows about the views of ONE build, whose proportions differ from view to view: which
places correspond, and which views look from the same side. No loss compares two builds, none sees a category's name.
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
    """InfoNCE between the views of each object, with soft targets by distance on its surface.

    A query patch must find, among the patches of the object's other views, those near its own surface point: the
    target falls with distance as a Gaussian of standard deviation `radius` (object units), up to 2.4 of these, and
    is 0 beyond. Descriptors are unit vectors. Returns the loss, as the divergence from the soft target so that 0 is
    perfect, and the share of queries whose nearest descriptor lies where the target is not 0.
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
    """Which of the object's other views looks from the same side? Cross-entropy over the best-view score.

    Views come in pairs (2k, 2k + 1). The score of two views is what the method chooses the best view by, in a form
    with gradients: the mean over one view's object patches, at most `queries` of them, of the highest similarity of
    their log-binned descriptors (or bare keys) in the other. Opposite sides, front and back, are among the wrong
    answers. Returns the loss and the share of views whose partner scores highest.
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
    out_of_question = torch.eye(views, dtype=torch.bool, device=keys.device) | ~seen[:, None]
    asked = seen & seen[:, partner]
    if not asked.any():
        return keys.sum() * 0, 0.0
    logits = (torch.stack(scores) / temperature).masked_fill(out_of_question, -1e4)[asked]
    answer = partner.expand(objects, -1)[asked]
    return F.cross_entropy(logits, answer), (logits.argmax(1) == answer).float().mean().item()


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
