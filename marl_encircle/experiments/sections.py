"""The sections of a configuration: which keys there are, of which types and within which bounds."""

from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    field_validator,
    model_serializer,
)

from marl_encircle.core.geometry import Closure
from marl_encircle.core.rewards import Reward
from marl_encircle.experiments.episodes import MAX_ROUNDS
from marl_encircle.experiments.records import Setting

Features = Literal["observation", "relative", "set"]
Count = Annotated[int, Field(ge=1, le=10**10)]
Share = Annotated[float, Field(ge=0, le=1)]
Episodes = Annotated[int, Field(ge=1, le=MAX_ROUNDS)]

MAX_LAYERS = 8

METHOD_NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$"
"""It names a folder and a row of the tables."""


def _even(value: int) -> int:
    if value % 2:
        raise ValueError("must be even")
    return value


def _off_as_empty(value: Any) -> Any:
    return {} if value is None else value


def _as_floats(value: Any) -> Any:
    """1 and 1.0 are one weight, and one hash."""
    if isinstance(value, dict):
        return {key: _as_floats(inner) for key, inner in value.items()}
    if isinstance(value, int) and not isinstance(value, bool):
        try:
            return float(value)
        except OverflowError as error:
            raise ValueError("number too large for a float") from error
    return value


class Section(BaseModel):
    """What all sections have in common: unknown keys and silent conversions are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class GrownSection(Section):
    """A section with keys that came after the first runs.

    They have defaults, and one that has its default is left out, so that the hashes of earlier runs stay.
    """

    @model_serializer(mode="wrap")
    def _without_defaults(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        defaults = self.defaults()
        return {key: value for key, value in handler(self).items() if key not in defaults or value != defaults[key]}

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """Return the values of the keys that have one by default."""
        fields = cls.model_fields.items()
        return {name: field.get_default(call_default_factory=True) for name, field in fields if not field.is_required()}


class SettingConfig(Section):
    """What a cell of the tables is about, apart from the method."""

    speed_ratio: float
    pursuers: int
    obstacles: int
    scene: str = "random"

    def build(self) -> Setting:
        """Return the setting."""
        return Setting(**self.model_dump())


class RewardConfig(Section):
    """A method: see :class:`marl_encircle.core.rewards.Reward`; ``name`` is the row of the tables."""

    name: Annotated[str, Field(pattern=METHOD_NAME)]
    closure: Closure = "all"
    two_stage: bool = True
    scale: float = 0.05
    terms: Annotated[dict[str, Any], AfterValidator(_as_floats)]

    def build(self) -> Reward:
        """Return the reward."""
        return Reward(self.terms, self.closure, self.two_stage, self.scale)


class ScheduleConfig(Section):
    """A straight line from ``start`` to ``end`` over ``world_steps``, then ``end``."""

    start: Annotated[float, Field(ge=0, le=10)]
    end: Annotated[float, Field(ge=0, le=10)]
    world_steps: Count


class AlgorithmConfig(GrownSection):
    """One of ``ALGORITHMS``. ``*_world_steps`` count steps of all pursuers of one world, ``train_freq`` vec steps."""

    name: str
    critic: Literal["per_agent", "shared"]
    net_arch: Annotated[list[Annotated[int, Field(ge=1, le=4096)]], Field(max_length=MAX_LAYERS)]
    learning_rate: Annotated[float, Field(gt=0, le=1)]
    batch_size: Annotated[int, Field(ge=1, le=1 << 20)]
    gamma: Share
    tau: Annotated[float, Field(gt=0, le=1)]
    policy_delay: Count
    actor_regularization: Annotated[float, Field(ge=0)]
    max_grad_norm: Annotated[float, Field(gt=0)] | None
    buffer_world_steps: Count
    random_world_steps: Annotated[int, Field(ge=0)]
    train_freq: Count
    gradient_steps: Count
    exploration_noise: ScheduleConfig
    exploration_random: Share
    learning_rate_end: Annotated[float, Field(gt=0, le=1)] | None = None
    n_steps: Annotated[int, Field(ge=1, le=1000)] = 1
    features: Features = "observation"


class RampConfig(Section):
    """A scenario field that moves in a straight line from ``start`` to its final value over ``world_steps``."""

    start: float
    world_steps: Count


Curriculum = Annotated[
    dict[Literal["safety_distance", "obstacle_radius", "speed_ratio"], RampConfig | None],
    BeforeValidator(_off_as_empty),
]
"""null switches all of it off."""


class TrainingConfig(GrownSection):
    """How long, in how many worlds, by which curriculum.

    :param settings: each has the same share of the worlds, what stands twice has two; none: the scenario's own has all
    """

    n_worlds: Annotated[int, Field(ge=1, le=1 << 16)]
    world_steps: Count
    curve_every: Count
    curriculum: Curriculum
    settings: Annotated[list[SettingConfig], Field(default_factory=list, max_length=100)]


class EvaluationConfig(Section):
    """Which rounds are played at the end of a training and for its learning curve."""

    episodes: Episodes
    seed: Annotated[int, Field(ge=0, lt=1 << 63)]
    curve_episodes: Episodes
    curve_seed: Annotated[int, Field(ge=0, lt=1 << 63)]
    n_directions: Annotated[int, Field(ge=8, le=4096), AfterValidator(_even)]

    @field_validator("curve_seed")
    @classmethod
    def _other_rounds(cls, curve_seed: int, info: ValidationInfo) -> int:
        if curve_seed == info.data.get("seed"):
            raise ValueError("must differ from evaluation.seed, whose rounds are reported")
        return curve_seed
