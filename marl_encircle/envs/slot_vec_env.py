"""What the native VecEnvs have in common: slots that are parts of one object."""

from typing import Any

from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices


class SlotVecEnv(VecEnv):
    """A VecEnv whose attributes and methods all slots share."""

    def close(self) -> None:
        """Do nothing: there is nothing to give back."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of this VecEnv once for each slot asked for."""
        return [getattr(self, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of this VecEnv; all slots share it."""
        setattr(self, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of this VecEnv, once, and return its result for each slot asked for."""
        result = getattr(self, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each slot: worlds are no Gymnasium environments that could be wrapped."""
        return [False for _ in self._get_indices(indices)]
