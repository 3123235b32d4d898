"""Sessions as TorchRL environments, and what a policy is rewarded for."""
