"""Learned strategies: networks that choose the next query."""

from torchrl_pref.policies.attention import attention_policy
from torchrl_pref.policies.base import PolicyKind
from torchrl_pref.policies.paper import paper_policy
from torchrl_pref.policies.scorer import scorer_policy

POLICIES: dict[str, PolicyKind] = {
    "scorer": PolicyKind(scorer_policy),
    "attention": PolicyKind(attention_policy, query="D", feed="D"),
    "paper": PolicyKind(paper_policy, query="NKD", feed="KD"),
}
"""The policies by name; each is made with an environment and its own settings."""
