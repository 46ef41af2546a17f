"""A hand-in: `method` matches the patches of two images.

Try it on objects with known poses:

    zsp-lite benchmark --pairs 5 --methods ours,mine=starter:method --out outputs/mine

After a change give the row another name, as in `mine2=starter:method`: a row that is there is not
computed again.
"""

import torch


def method(similarity, foreground1, foreground2):
    """Match each patch to the most similar one, and score it by how much the second is behind.

    Args:
        similarity: Cosines between the patches of the two images, a tensor (n1, n2).
        foreground1: Which patches of the first image are on the object (n1,).
        foreground2: Which patches of the second image are on the object (n2,).

    Returns:
        The index of the partner of each patch of the first image, and its score; -inf for none.
    """
    similarity = similarity.clone()
    similarity[:, ~foreground2] = -1  # the lowest cosine
    best, partner = similarity.topk(2, dim=1)
    score = best[:, 0] - best[:, 1]
    score[~foreground1] = -torch.inf
    return partner[:, 0], score
