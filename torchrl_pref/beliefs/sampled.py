"""The belief over the reward weights ω: samples on the unit sphere, batched over sessions.

Shapes: S sessions, M samples, H answers, F factors of an answer, J rows of a factor, D features.

The prior is uniform on the unit sphere: alignment ignores the scale of ω, and tau carries it.
After each answer the samples take a step of *resample-move* (Gilks and Berzuini, 2001): reweight by
the likelihood of the new answer, resample, then move every sample with Markov moves that leave the
new posterior invariant (see ``slice.py``). An answer that too few samples agree with is let in by
stages, and one that hardly any sample foresaw makes the belief begin anew from the prior, as any
soft one does where there are two features, see :meth:`Belief.update`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from torchrl_pref.beliefs.base import BeliefBase, Update
from torchrl_pref.beliefs.resampling import (
    agreement,
    explained_share,
    furthest,
    kish_share,
    log_ratio,
    resample,
)
from torchrl_pref.beliefs.slice import Target, round_of_moves
from torchrl_pref.config.memory import LEAST_SAMPLES, default_moves
from torchrl_pref.errors import check_count, check_type
from torchrl_pref.questions.base import Evidence
from torchrl_pref.questions.response_model import ResponseModel
from torchrl_pref.tensors import check_finite

MIN_SHARE = 0.25
"""Kish effective share of the samples that a reweighting must keep; below it a stage is added."""

MAX_STAGES = 12
"""Of one answer: twelve stages that keep a quarter each leave less than one in ten million."""

SURPRISE = 0.1
"""A soft answer makes the belief begin anew where the samples together gave it less than this share
of the probability that it could have: what none of them is near may then weigh as much."""

CIRCLE = 2
"""Features of which a belief begins anew with every soft answer. It costs little there, and it is
there that a needle of the posterior, too narrow for one sample in a hundred, grows to a share that
counts by answers none of which is a surprise."""

RESTART_SHARE, RESTART_STAGES = 0.5, 500
"""What each stage of a new beginning keeps, and how many stages there may be: it must find every
mode, and how much each holds."""

CIRCLE_SHARE = 0.8
"""What it keeps on a circle, where larger steps give the heaviest of several modes too little."""

FORGOTTEN = 0.95
"""Moves are repeated until the effective sample size is this share of the samples, at most
``MAX_ROUNDS`` times."""

MAX_ROUNDS = 5

MOVED = 2**20
"""Moves of samples that are made at once: bounds memory whatever the number of sessions."""


def uniform_sphere(shape: tuple[int, ...], generator: Generator) -> Tensor:
    """Draw weights uniformly on the unit sphere, (… D), on the generator's device."""
    normal = torch.randn(shape, generator=generator, device=generator.device)
    return F.normalize(normal, dim=-1)


class Belief(BeliefBase):
    """Posterior samples of ω under an assumed response model.

    Args:
        response_model: how the belief thinks the human answers. It may differ from how they do.
        samples: M, at least 8. With fewer than 20 each sample has too much of a say in where the
            others move, and the spread comes out up to 3% too small.
        moves: Markov moves after each resampling, at least 1; None: as many as there are features
            (D²/8 beyond 8, D³/128 beyond 16), and at least 4. They are repeated where the samples
            have not forgotten where they were.

    Raises:
        InputError: there is no response model, or ``samples`` or ``moves`` is too small.
    """

    def __init__(
        self, response_model: ResponseModel, samples: int = 100, moves: int | None = None
    ) -> None:
        check_type("response_model", response_model, ResponseModel, "Boltzmann(2.0)")
        self.response_model = response_model
        self.n_samples = check_count("belief.samples", samples, LEAST_SAMPLES)
        self.n_moves = None if moves is None else check_count("belief.moves", moves, 1)

    def prior(self, n_sessions: int, n_features: int, generator: Generator) -> Tensor:
        """Samples of the prior, (S M D)."""
        return uniform_sphere((n_sessions, self.n_samples, n_features), generator)

    def update(
        self, samples: Tensor, ess: Tensor, answers: Evidence, generator: Generator
    ) -> Update:
        r"""See :meth:`BeliefBase.update`.

        Reweighting by an answer that few samples agree with would leave copies of a handful; a hard
        answer could leave none. The answer is then let in by stages: its return gaps are raised by
        a slack, the smallest that keeps ``MIN_SHARE`` of the samples effective, and the stages end
        at a slack of zero, which is the exact posterior.

        An answer that hardly any sample foresaw says that most of the posterior may lie where there
        are no samples, which no move would mend. The belief then begins anew from the prior and
        lets in all answers together, by a power of their likelihood that rises to one (Neal,
        *Annealed importance sampling*, 2001). Of two features it does so with every soft answer.

        The effective sample size follows the samples through it all. Resampling multiplies the
        variance of the mean, by the average multiplicity where all samples count alike; moves after
        which a share of the variance is still explained by the places before leave that share of
        the excess. M divided by that inflation is the size of an independent sample as good for
        estimating the mean.
        """
        check_finite("samples or features of the answers", samples, answers.rows)
        size = max(1, MOVED // (self.n_samples * self._moves_for(samples.shape[-1])))
        if len(samples) <= size:
            return self._update(samples, ess, answers, generator)
        parts = (slice(first, first + size) for first in range(0, len(samples), size))
        updates = [self._update(samples[s], ess[s], answers[s], generator) for s in parts]
        return Update(*(torch.cat(field) for field in zip(*updates, strict=True)))

    def _moves_for(self, n_features: int) -> int:
        """V."""
        return default_moves(n_features) if self.n_moves is None else self.n_moves

    def _update(
        self, samples: Tensor, ess: Tensor, answers: Evidence, generator: Generator
    ) -> Update:
        """:meth:`update` for as many sessions as are held in memory at once."""
        foreseen = self._likelihood(samples, answers[:, -1])
        limit = math.inf if samples.shape[2] == CIRCLE else SURPRISE
        share, likelihood = agreement(foreseen)
        anew, few = likelihood < limit, share < MIN_SHARE
        inflation = self.n_samples / ess
        if not (anew | few).any():
            after = self._let_in(samples, inflation, answers, generator, foreseen)
        else:
            if anew.any():
                indeed = self._surprised(samples[anew], answers[anew], foreseen[anew].exp(), limit)
                anew = anew.masked_scatter(anew, indeed)
            few &= ~anew
            plain = ~(anew | few)
            after = samples.clone(), inflation, torch.ones_like(plain)
            for who, condition in (
                (plain, partial(self._let_in, likelihood=foreseen[plain])),
                (few, self._let_in_by_stages),
                (anew, self._begin_anew),
            ):
                if who.any():
                    some = condition(samples[who], inflation[who], answers[who], generator)
                    for whole, part in zip(after, some, strict=True):
                        whole[who] = part
        moved, inflation, used = after
        return Update(moved, torch.where(used, self.n_samples / inflation, ess), used)

    def _likelihood(self, samples: Tensor, answers: Evidence) -> Tensor:
        """(S M), log-likelihood of an answer (S) or of all answers (S H) under samples (S M D)."""
        gaps, floor = answers.gaps(samples), answers.floor.unsqueeze(1)
        model, one = self.response_model, answers.floor.ndim == 1
        return (model.answer_log_likelihood if one else model.joint_log_likelihood)(gaps, floor)

    def _surprised(
        self, samples: Tensor, answers: Evidence, foreseen: Tensor, limit: float
    ) -> Tensor:
        """(S), whether samples (S M D) gave the last of answers (S H), which they foresaw so likely
        (S M), less than this share of what it could have, and no answer is impossible."""
        newest = answers[:, -1]
        # The most that any ω would give it, or nearly: that of the sample or the mean row.
        ahead = F.normalize(newest.rows.sum((1, 2)), dim=-1).unsqueeze(1)
        most = torch.cat([foreseen, self._likelihood(ahead, newest).exp()], 1).amax(1)
        # Where an answer can be impossible no power of its likelihood makes it less so.
        against = Evidence(-answers.rows, answers.offsets, answers.floor)
        possible = self._likelihood(samples, against).isfinite().all(1)
        return possible & (foreseen.mean(1) < limit * most)

    def _let_in(
        self,
        samples: Tensor,
        inflation: Tensor,
        answers: Evidence,
        generator: Generator,
        likelihood: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Let in at once the last of the answers, of log-likelihood (S M) under the samples.

        Returns:
            Samples (S M D), inflation (S), and that the answer was used (S).
        """
        one = torch.ones_like(inflation)
        target = Target(answers, torch.zeros_like(inflation), one, self.response_model)
        log_weights = self._foreseen(samples, answers, likelihood)
        after = self._resample_move(samples, inflation, log_weights, target, generator)
        return *after, one.bool()

    def _let_in_by_stages(
        self, samples: Tensor, inflation: Tensor, answers: Evidence, generator: Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Let in the last of the answers, by a slack that falls to zero.

        Returns:
            Samples (S M D), inflation (S), and whether the answer was used (S): one that no sample
            agrees with in the end contradicts the earlier ones.
        """
        model, before = self.response_model, (samples, inflation)
        samples, inflation = samples.clone(), inflation.clone()
        slack = torch.full_like(inflation, math.inf)
        todo = torch.arange(len(samples), device=samples.device)
        for stage in range(MAX_STAGES):
            if todo.numel() == 0:
                break
            raised = self._raised(samples[todo], answers[todo])
            log_now = raised(slack[todo])
            next_slack = self._next_slack(samples[todo], answers[todo], slack[todo], log_now)
            if stage == MAX_STAGES - 1:
                # Better a few copies than no answer: only an impossible one is left out.
                possible = raised(torch.zeros_like(next_slack)) > -math.inf
                next_slack = torch.where(possible.any(1), 0.0, next_slack)
            slack[todo] = next_slack
            log_weights = log_ratio(raised(next_slack), log_now)
            target = Target(answers[todo], next_slack, torch.ones_like(next_slack), model)
            given = samples[todo], inflation[todo], log_weights, target, generator
            samples[todo], inflation[todo] = self._resample_move(*given)
            todo = todo[next_slack > 0]
        # In float64, where one gap and its negative differ by nothing that counts.
        gaps, floor = answers.double().gaps(samples.double()), answers.floor.unsqueeze(1).double()
        possible = model.joint_log_likelihood(gaps, floor) > -math.inf
        agrees = model.agrees(gaps[:, :, -1]) & possible
        used = (slack == 0) & agrees.any(1)
        samples = torch.where(used[:, None, None], samples, before[0])
        return samples, torch.where(used, inflation, before[1]), used

    def _begin_anew(
        self, samples: Tensor, inflation: Tensor, answers: Evidence, generator: Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Let in all answers from the prior, by a power of their likelihood that rises to one.

        What the samples were before does not matter.

        Returns:
            Samples (S M D), inflation (S), and that the answer was used (S).
        """
        samples = self.prior(len(samples), samples.shape[2], generator).to(samples)
        inflation, power = torch.ones_like(inflation), torch.zeros_like(inflation)
        share = CIRCLE_SHARE if samples.shape[2] == CIRCLE else RESTART_SHARE
        todo = torch.arange(len(samples), device=samples.device)
        for stage in range(RESTART_STAGES):
            if todo.numel() == 0:
                break
            tempered, now = self._tempered(samples[todo], answers[todo]), power[todo]
            next_power = self._next_power(tempered, now, share)
            if stage == RESTART_STAGES - 1:
                next_power = torch.ones_like(now)
            power[todo] = next_power
            log_weights = tempered(now, next_power)
            target = Target(answers[todo], torch.zeros_like(now), next_power, self.response_model)
            given = samples[todo], inflation[todo], log_weights, target, generator
            samples[todo], inflation[todo] = self._resample_move(*given)
            todo = todo[next_power < 1]
        return samples, inflation, torch.ones_like(power, dtype=torch.bool)

    def _next_power(
        self, tempered: Callable[[Tensor, Tensor], Tensor], power: Tensor, share: float
    ) -> Tensor:
        """(S), the largest power of the likelihood that keeps a share of the samples effective."""
        likelihood = tempered(torch.zeros_like(power), torch.ones_like(power))
        # By this much no weight becomes more than twice another.
        spread = (likelihood.amax(1) - likelihood.amin(1)).clamp(min=1e-20)
        return furthest(
            (power + math.log(2) / spread).clamp(max=1),
            torch.ones_like(power),
            lambda to: kish_share(tempered(power, to)) >= share,
        )

    def _foreseen(self, samples: Tensor, answers: Evidence, likelihood: Tensor) -> Tensor:
        """(S M), log-weights of samples (S M D) of the belief after all answers (S H) but the last,
        whose log-likelihood under them is given (S M)."""
        return likelihood

    def _raised(self, samples: Tensor, answers: Evidence) -> Callable[[Tensor], Tensor]:
        """From a slack (… S) to the log-weights (… S M) that let in an answer whose gaps are raised
        by it; infinite slack gives 0."""
        newest = answers[:, -1]
        gaps, floor = newest.gaps(samples), newest.floor.unsqueeze(1)

        def raised(slack: Tensor) -> Tensor:
            more = gaps + slack.nan_to_num(posinf=0.0)[..., None, None, None]
            log_likelihood = self.response_model.answer_log_likelihood(more, floor)
            return log_likelihood.masked_fill(slack.isinf()[..., None], 0.0)

        return raised

    def _tempered(self, samples: Tensor, answers: Evidence) -> Callable[[Tensor, Tensor], Tensor]:
        """From two powers (… S) to by how much the log-density of samples (S M D) is higher where
        the likelihood of answers (S H) is raised to the second (… S M)."""
        likelihood = self._likelihood(samples, answers)
        return lambda now, to: (to - now).unsqueeze(-1) * likelihood

    def _next_slack(
        self, samples: Tensor, answers: Evidence, slack: Tensor, log_now: Tensor
    ) -> Tensor:
        """(S), the smallest slack that keeps enough of samples (S M D) effective."""
        result = torch.zeros_like(slack)
        few = kish_share(log_ratio(self._raised(samples, answers)(result), log_now)) < MIN_SHARE
        if few.any():
            raised, log_now = self._raised(samples[few], answers[few]), log_now[few]
            # At this slack every sample agrees, so no factor of the answer tells them far apart.
            gaps = answers[few, -1].gaps(samples[few])
            start = torch.minimum(slack[few], (-gaps).amax((1, 2, 3)).clamp(min=0))
            result[few] = furthest(
                start,
                torch.zeros_like(start),
                lambda to: kish_share(log_ratio(raised(to), log_now)) >= MIN_SHARE,
            )
        return result

    def _resample_move(
        self,
        samples: Tensor,
        inflation: Tensor,
        log_weights: Tensor,
        target: Target,
        generator: Generator,
    ) -> tuple[Tensor, Tensor]:
        """New samples (S M D) and the inflation (S) of the variance of their mean."""
        start, factor = resample(samples, log_weights, generator)
        excess = inflation * factor - 1
        moved = self._move(start, target, generator)
        inflation = 1 + explained_share(start, moved) * excess
        for _ in range(MAX_ROUNDS - 1):
            who = (inflation > 1 / FORGOTTEN).nonzero().squeeze(-1)
            if len(who) == 0:
                break
            moved[who] = self._move(moved[who], target.of(who), generator)
            inflation[who] = 1 + explained_share(start[who], moved[who]) * excess[who]
        return moved, inflation.clamp(1, samples.shape[1])

    def _move(self, samples: Tensor, target: Target, generator: Generator) -> Tensor:
        """Samples (S M D) after Markov moves that leave the target invariant."""
        return round_of_moves(samples, self._moves_for(samples.shape[2]), target, generator)
