"""The faults that ``faults.py`` plants: slips that leave code that runs, with a wrong result.

Those in files that Numba compiles come last: each makes such a file compile anew, and so does
putting it back.
"""

from __future__ import annotations

from typing import NamedTuple


class Fault(NamedTuple):
    """A slip, and who ought to notice it."""

    what: str
    """In plain words."""
    file: str
    """In the package."""
    old: str
    """What stands there, once."""
    new: str
    """What is put in its place."""
    tests: str
    """Files in ``tests/``, or tests in them, with spaces between."""


OBJECTIVES, ENVS = "envs/test_objectives.py", "envs/test_envs.py"
TORCHRL, BATCH = "envs/test_torchrl.py", "acquisition/test_batch.py"
STRATEGIES, POLICIES = "strategies/test_strategies.py", "policies/test_policies.py"
TRAINING, PARTS = "training/test_training.py", "training/test_parts.py"
EVALUATION, HELDOUT = "evaluation/test_evaluation.py", "evaluation/test_heldout.py"

FAULTS = (
    Fault(
        "running out of free offers interrupts a session and does not end it",
        "envs/feed.py",
        "terminated = terminated | out_of_offers",
        "terminated = terminated.clone()",
        OBJECTIVES,
    ),
    Fault(
        "a skipped offer comes again where another should come",
        "envs/feed.py",
        'if self.on_skip == "new"',
        'if self.on_skip != "new"',
        ENVS,
    ),
    Fault(
        "the share of offers that is left is one behind",
        "envs/feed.py",
        "1 - n_offered / self.n_offers",
        "1 - (n_offered - 1) / self.n_offers",
        ENVS,
    ),
    Fault(
        "the share of asks that is left is one ahead",
        "envs/session.py",
        "1 - n_asked / self.budget",
        "1 - (n_asked + 1) / self.budget",
        ENVS,
    ),
    Fault(
        "all sessions have the same candidates",
        "envs/query.py",
        "torch.rand(shape, generator=self.generator, device=self.device)",
        "torch.rand(shape[1:], generator=self.generator, device=self.device).expand(shape)",
        ENVS,
    ),
    Fault(
        "of a batch only the last answer counts",
        "envs/query.py",
        "self._ask(after, human, query, going_on)",
        "self._ask(session, human, query, going_on)",
        "envs/test_batch_env.py",
    ),
    Fault(
        "humans see the features that the belief knows, and not their own",
        "envs/session.py",
        "seen = options if self.seen is None else self.seen[index]",
        "seen = options",
        "envs/test_given.py",
    ),
    Fault(
        "a copy of an environment without a seed faces the same humans",
        "envs/session.py",
        "self._home != (os.getpid(), id(self))",
        "self._home[0] != os.getpid()",
        f"{TORCHRL}::test_a_copy_faces_other_humans_unless_it_has_a_seed",
    ),
    Fault(
        "information is counted by the belief after the answer",
        "envs/transition.py",
        "score_queries(samples, query, model, information_gain)",
        "score_queries(update.samples, query, model, information_gain)",
        ENVS,
    ),
    Fault(
        "random actions obey the mask of the sessions that did not begin",
        "envs/allowed.py",
        "mask, self.mask)",
        "self.mask, mask)",
        f"{TORCHRL}::test_random_actions_respect_the_mask_where_sessions_begin_apart",
    ),
    Fault(
        "a history may have a gap",
        "envs/state.py",
        "(asked != first).any()",
        "(asked != first).all()",
        "envs/test_inputs.py",
    ),
    Fault(
        "the effective sample size forgets what was lost before",
        "beliefs/sampled.py",
        "excess = inflation * factor - 1",
        "excess = factor - 1",
        "beliefs/test_belief.py::test_what_was_lost_before_counts_until_it_is_forgotten "
        "beliefs/test_belief.py::test_effective_sample_size_is_what_it_says",
    ),
    Fault(
        "a belief begins anew with the samples that it has, and not from the prior",
        "beliefs/sampled.py",
        "samples = self.prior(len(samples), samples.shape[2], generator).to(samples)",
        "samples = samples.clone()",
        "beliefs/test_belief.py",
    ),
    Fault(
        "moves in tensors take the sphere to have a dimension more",
        "beliefs/slice.py",
        "meridians = samples.shape[-1] - 2",
        "meridians = samples.shape[-1] - 1",
        "beliefs/test_sampler.py",
    ),
    Fault(
        "the offset of resampling is halved where it is drawn",
        "beliefs/resampling.py",
        "offset = torch.rand(",
        "offset = 0.5 * torch.rand(",
        "beliefs/test_sampler.py",
    ),
    Fault(
        "the prior of tau is too narrow",
        "beliefs/lengths_cpu.py",
        "return 0.5 * (log_length / deviation) ** 2",
        "return (log_length / deviation) ** 2",
        "beliefs/test_rationality.py",
    ),
    Fault(
        "the centre of the Gaussian is left at the mode",
        "beliefs/laplace.py",
        "centre = F.normalize(found.mode, dim=-1) * length",
        "centre = found.mode",
        "beliefs/test_laplace.py",
    ),
    Fault(
        "what is known of the lapse rate from earlier answers counts once too often",
        "beliefs/lapses.py",
        "known = known.log_softmax(-1)",
        "known = known.clone()",
        "beliefs/test_rationality.py",
    ),
    Fault(
        "scores are kept of a belief that was changed in place",
        "beliefs/per_belief.py",
        "self._samples = samples.clone()",
        "self._samples = samples",
        "beliefs/test_per_belief.py",
    ),
    Fault(
        "volume removal by the mean of squares, and not the square of the mean",
        "acquisition/functions.py",
        "return 1 - predicted.probs.mean(-2).square().sum(-1)",
        "return 1 - predicted.probs.square().mean(-2).sum(-1)",
        "acquisition/test_functions.py acquisition/test_acquisition.py",
    ),
    Fault(
        "several scores come in the order of the loops, and not as asked for",
        "acquisition/scoring.py",
        "scores[..., [COMPILED.index(each) for each in functions]]",
        "scores[..., : len(functions)]",
        "acquisition/test_acquisition.py",
    ),
    Fault(
        "scores are standardised over all sessions together",
        "acquisition/scoring.py",
        "mean = scores.mean(-2, keepdim=True)",
        "mean = scores.mean((0, -2), keepdim=True)",
        POLICIES,
    ),
    Fault(
        "of two questions that are alike the better one is dropped",
        "acquisition/batch.py",
        "worse = max(first, second)",
        "worse = min(first, second)",
        BATCH,
    ),
    Fault(
        "the kernel of the point process is wider than the authors'",
        "acquisition/batch.py",
        "math.log(4 * n)",
        "math.log(2 * n)",
        BATCH,
    ),
    Fault(
        "answers about options in another order are led back the wrong way",
        "questions/base.py",
        "_as_keys(contrasts[..., place_of], offsets, log_weights)",
        "_as_keys(contrasts[..., list(order)], offsets, log_weights)",
        "questions/test_conformance.py",
    ),
    Fault(
        "of a weak question the first answer says that the second option is better",
        "questions/weak.py",
        "torch.stack([one_way, other_way, torch",
        "torch.stack([other_way, one_way, torch",
        "questions/test_conformance.py",
    ),
    Fault(
        "a ranking is taken to name the worst first",
        "questions/ranking.py",
        "placed[:, place : place + 1] - placed[:, place + 1 :]",
        "placed[:, place + 1 :] - placed[:, place : place + 1]",
        "questions/test_conformance.py",
    ),
    Fault(
        "what pads answers beside demonstrations counts as ties",
        "questions/prior_evidence.py",
        "(0, more[1], 0, more[0]), value=torch.inf)",
        "(0, more[1], 0, more[0]))",
        "questions/test_prior_evidence.py",
    ),
    Fault(
        "a demonstration counts the less, the more careful it is",
        "questions/prior_evidence.py",
        "return tau / model.scale",
        "return model.scale / tau",
        "questions/test_prior_evidence.py",
    ),
    Fault(
        "who drifts does not end where they are judged",
        "humans/drifting.py",
        "steps[:, -1] = 0",
        "steps[:, 0] = 0",
        "humans/test_imperfect.py",
    ),
    Fault(
        "who is undecided never lapses",
        "humans/imperfect.py",
        "Boltzmann(response_model.scale, lapse=response_model.lapse)",
        "Boltzmann(response_model.scale)",
        "humans",
    ),
    Fault(
        "the last offers are not forced by the threshold rule",
        "strategies/feed.py",
        "ask = (value >= self.threshold) | (share >= 1)",
        "ask = value >= self.threshold",
        STRATEGIES,
    ),
    Fault(
        "the quantile rule turns from the later value to the first",
        "strategies/feed.py",
        "torch.stack([left, 1 - left], 1)",
        "torch.stack([1 - left, left], 1)",
        STRATEGIES,
    ),
    Fault(
        "urgency is that of one ask later",
        "policies/scorer.py",
        "self.budget / (n_asked + 1)",
        "self.budget / (n_asked + 2)",
        POLICIES,
    ),
    Fault(
        "the last offers are not forced on a policy",
        "policies/scorer.py",
        "margin = rank - (1 - eager) + (share >= 1)",
        "margin = rank - (1 - eager)",
        POLICIES,
    ),
    Fault(
        "gamma discounts by the offer where skips are free",
        "training/trainer.py",
        'batch["next", "n_asked"] - batch["n_asked"]',
        'torch.ones_like(batch["n_asked"])',
        f"{TRAINING}::test_gamma_counts_questions_where_skips_are_free",
    ),
    Fault(
        "the average of the weights holds the newest alone, but for a trace",
        "training/trainer.py",
        "lerp_(weight, 1 - self.settings.average)",
        "lerp_(weight, self.settings.average)",
        f"{TRAINING}::test_warm_up_spares_the_actor_and_the_average_follows",
    ),
    Fault(
        "a session that was cut off is taken to be worth nothing more",
        "training/sessions.py",
        "later[who, t] = value",
        "later[who, t] = 0.0",
        f"{TRAINING}::test_a_batch_has_the_values_of_each_state_and_the_next",
    ),
    Fault(
        "a part has the same luck in every batch",
        "training/parts.py",
        "self.luck = torch.get_rng_state()",
        "torch.get_rng_state()",
        f"{PARTS}::test_each_part_has_its_own_humans_and_luck",
    ),
    Fault(
        "a process goes on asking by the first weights",
        "training/worker.py",
        'part.sessions.policy.weights.load_state_dict(message["weights"])',
        'message.pop("weights")',
        f"{PARTS}::test_processes_of_their_own_or_none_change_nothing",
    ),
    Fault(
        "a resumed run has an optimizer that knows nothing",
        "checkpoints/restore.py",
        '{"state": dict(steps),',
        '{"state": {},',
        f"{TRAINING}::test_resumed_run_equals_an_uninterrupted_one_bit_for_bit",
    ),
    Fault(
        "the spread of the humans of older runs is lost",
        "checkpoints/migrations.py",
        'settings.pop("tau_spread", 1)',
        'settings.pop("spread", 1)',
        "checkpoints/test_migrations.py",
    ),
    Fault(
        "the interval is not widened for few pools",
        "evaluation/statistics.py",
        "math.sqrt(len(values) / max(1, len(values) - 1))",
        "1.0",
        f"{HELDOUT}::test_interval_covers_pools_and_seeds "
        f"{HELDOUT}::test_interval_is_widened_by_what_few_pools_hide",
    ),
    Fault(
        "the environment is not seeded anew for each strategy that is compared",
        "evaluation/comparison.py",
        "        env.set_seed(seed)\n",
        "",
        f"{EVALUATION}::test_compared_strategies_have_the_luck_that_they_have_alone",
    ),
    Fault(
        "policies that are compared draw their actions one after the other",
        "evaluation/comparison.py",
        "        torch.manual_seed(seed)\n",
        "",
        f"{EVALUATION}::test_compared_strategies_have_the_luck_that_they_have_alone",
    ),
    Fault(
        "slots that were not asked count as repeats",
        "evaluation/run.py",
        "same.tril(-1).any(-1) & (history >= 0)",
        "same.tril(-1).any(-1)",
        EVALUATION,
    ),
    Fault(
        "a test pool is balanced by itself, and not by the training pool",
        "evaluation/heldout_pool.py",
        "balance(train.features)",
        "balance(each.features)",
        f"{HELDOUT}::test_features_are_balanced_by_the_training_pool",
    ),
    Fault(
        "policies of two kinds of training are taken for two seeds of one",
        "evaluation/heldout.py",
        '(*APART, "training", "pool")',
        '(*APART, "pool")',
        f"{HELDOUT}::test_policies_that_differ_in_their_seed_alone_are_one_kind "
        f"{HELDOUT}::test_policies_of_two_trainings_are_two_kinds",
    ),
    Fault(
        "a file is copied to its place, and not put there at once",
        "storage/writing.py",
        "os.replace(partial, path)",
        "path.write_bytes(partial.read_bytes())",
        "test_pool.py",
    ),
    Fault(
        "columns are taken from the left, and not by their names",
        "storage/tables.py",
        "places = [header.index(name) for name in chosen]",
        "places = list(range(len(chosen)))",
        "storage/test_tables.py",
    ),
    Fault(
        "the log of a person is ordered by the clock",
        "study/log.py",
        "ORDER BY number",
        "ORDER BY at",
        "study/test_log.py",
    ),
    Fault(
        "undoing an earlier answer takes back the last one alone",
        "session.py",
        "del self._states[place + 1 :], self._turns[place:]",
        "del self._states[-1:], self._turns[place:]",
        "test_session.py",
    ),
    Fault(
        "all turns of a session have the same luck",
        "session.py",
        "return self.seed * PRIME + self.n_answered",
        "return self.seed * PRIME",
        "test_session.py",
    ),
    Fault(
        "the estimate of memory forgets what pads answers beside demonstrations",
        "config/memory.py",
        'n_rows = max(n_rows, shown["alternatives"])',
        'n_rows = min(n_rows, shown["alternatives"])',
        "config/test_settings.py::"
        "test_the_estimate_pads_answers_and_demonstrations_as_the_session_does",
    ),
    Fault(
        "starts and moves of the Gridworld have one seed",
        "tasks/gridworld.py",
        "Generator().manual_seed(seed + 1)",
        "Generator().manual_seed(seed)",
        "test_pool.py",
    ),
    Fault(
        "the offset of resampling is halved in the loop",
        "beliefs/resampling_cpu.py",
        "(i + offset[s])",
        "(i + 0.5 * offset[s])",
        "beliefs/test_sampler.py",
    ),
    Fault(
        "all answers are eased where the newest should be",
        "beliefs/slice_cpu.py",
        "(slack if newest else 0.0)",
        "slack",
        "beliefs/test_sampler.py",
    ),
    Fault(
        "alignment is gained by samples and not by their directions",
        "acquisition/scoring_cpu.py",
        "_gains(probs, sums, bits, pointed, left)",
        "_gains(probs, sums, bits, centred, left)",
        "beliefs/test_rationality.py"
        "::test_scores_take_returns_from_samples_and_directions_for_alignment",
    ),
    Fault(
        "every answer at random is as likely as all of them together",
        "acquisition/scoring_table_cpu.py",
        "at_random, weight = lapse / n_answers,",
        "at_random, weight = lapse,",
        "questions/test_conformance.py",
    ),
)
