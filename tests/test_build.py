"""From settings to what they describe."""

from helpers import settings_of

from torchrl_pref.build import make_pools, make_query_env, make_task


def test_human_and_belief_have_lapse_rates_of_their_own() -> None:
    settings = settings_of("query")
    settings["human"]["lapse"], settings["belief"]["lapse"] = 0.2, 0.1
    task = make_task(*make_pools(settings), "noisy", settings)
    assert (task.human_model.lapse, task.response_model.lapse) == (0.2, 0.1)
    env = make_query_env(settings, task, task.train, 2, 0)
    assert (env.human.response_model.lapse, env.belief.response_model.lapse) == (0.2, 0.1)
