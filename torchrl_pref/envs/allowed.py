"""What random actions are drawn from where some are not allowed.

Shapes: B sessions, C candidates, n questions asked at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite


@dataclass
class Table:
    """What is on the table now.

    Attributes:
        mask: (B C), candidates that may be asked; None before the first reset.
        batch: n.
    """

    mask: Tensor | None = None
    batch: int = 1

    def show(self, mask: Tensor, begun: Tensor | None = None) -> None:
        """Put candidates on the table, in all sessions or where they have begun (B 1)."""
        if self.mask is not None and begun is not None:
            mask = torch.where(begun.reshape(-1, 1), mask, self.mask)
        self.mask = mask


class AllowedActions(Composite):
    """The spec of an ``action`` that is drawn from what is allowed now.

    Specs are copied by whatever wraps an environment; these copies look at the same table, as long
    as they are in the same process and no transform has put a mask of its own in its place. The
    ``Categorical`` within is TorchRL's own, which is what its losses know.
    """

    table: Table | None = None

    def clone(self) -> AllowedActions:
        """A copy that looks at the same table."""
        copy: AllowedActions = super().clone()
        copy.table = self.table
        return copy

    def rand(self, shape: torch.Size | None = None) -> TensorDictBase:
        """An allowed action for each session, (… B) or (… B n)."""
        allowed = None if self.table is None else self.table.mask
        inner, leading = self["action"], torch.Size(shape or ())
        n = 1 if self.table is None else self.table.batch
        several = () if n == 1 else (n,)
        if allowed is None or inner.mask is not None:
            return super().rand(leading)
        if (*allowed.shape[:-1], *several) != tuple(inner.shape):
            return super().rand(leading)
        drawn = allowed.float().repeat(leading.numel(), 1).multinomial(n).to(inner.device)
        drawn = drawn.reshape(*leading, *inner.shape)
        return TensorDict({"action": drawn}, (*leading, *self.shape), device=self.device)
