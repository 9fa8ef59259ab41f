"""Settings of a training run: network, PPO, evaluation, and all of it together."""

from dataclasses import dataclass, field, replace

from segvisrl_jax.config.checks import LONGEST_NAME_BYTES, ConfigError, require, require_choice, require_types
from segvisrl_jax.config.environment import EnvConfig
from segvisrl_jax.config.names import ARCH_OBSERVATION, Arch, LoggerName, PresetName
from segvisrl_jax.config.paths import A_PATH, RUNS_DIR, is_path

LARGEST_BATCH = 10**8  # decisions: beyond it, images of any size fill every memory
MOST_DEVICES = 2**16


@dataclass(frozen=True)
class NetworkConfig:
    """The policy and value network (paper, section III-D)."""

    channels: tuple[int, ...] = (16, 32, 32)
    """Channels of the Impala CNN's stages (paper)."""
    blocks_per_stage: int = 2
    """Residual blocks in each stage (paper)."""
    feature_size: int = 256
    """Width of the dense layer behind the CNN."""
    lstm_size: int = 256
    """Width of the LSTM."""
    mlp_sizes: tuple[int, ...] = (128, 128)
    """Hidden layers of the architectures mlp and mlp_rocks."""
    bounded_mean: bool = True
    """The Gaussian's mean is squashed to the wheels' range [0, 1]; else it is free."""
    mean_overshoot: float = 0.0
    """How far beyond that range the squashed mean may go, so that it is not saturated at full speed and none."""
    initial_std: float = 0.25
    """Standard deviation of the action at the start, as a share of the top speed."""
    min_std: float = 0.01
    """What the standard deviation does not fall below (at 0, log-probabilities would explode)."""
    initial_turn: float = 0.0
    """By how much the right wheel is faster than the left at the start, as a share of the top speed: above 0, a policy
    turns left until it learns otherwise."""

    def __post_init__(self) -> None:
        p = "network"
        require_types(self, p)
        for name, sizes in (("channels", self.channels), ("mlp_sizes", self.mlp_sizes)):
            good = 1 <= len(sizes) <= 32 and all(1 <= size <= 4096 for size in sizes)
            require(good, f"{p}.{name}", sizes, "one or more whole numbers in [1, 4096], at most 32 of them")
        require(0 <= self.blocks_per_stage <= 16, f"{p}.blocks_per_stage", self.blocks_per_stage, "in [0, 16]")
        require(1 <= self.feature_size <= 8192, f"{p}.feature_size", self.feature_size, "in [1, 8192]")
        require(1 <= self.lstm_size <= 8192, f"{p}.lstm_size", self.lstm_size, "in [1, 8192]")
        require(0 < self.initial_std <= 10, f"{p}.initial_std", self.initial_std, "in (0, 10]")
        require(0.001 <= self.min_std <= self.initial_std, f"{p}.min_std", self.min_std, "in [0.001, initial_std]")
        require(0 <= self.mean_overshoot <= 1, f"{p}.mean_overshoot", self.mean_overshoot, "in [0, 1]")
        require(-1 < self.initial_turn < 1, f"{p}.initial_turn", self.initial_turn, "in (-1, 1)")


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation (paper, table I, gives steps, epochs, rates and weights)."""

    num_envs: int = 32
    """Environments that drive at once (paper: 1)."""
    unroll_length: int = 64
    """Decisions of each environment between two updates (paper: 64)."""
    num_minibatches: int = 8
    """Parts of a batch, cut by environment and never in time (paper: 1)."""
    num_epochs: int = 4
    """Passes over a batch (paper: 4)."""
    learning_rate: float = 1e-3
    """Adam's rate at the start (paper: 3e-4)."""
    final_learning_rate_share: float = 0.05
    """The rate falls linearly to this share of itself at the end (paper: 1, constant)."""
    discount: float = 0.97
    """What a reward is worth one decision later, its gamma (paper: 0.85)."""
    gae_lambda: float = 0.95
    """The lambda of generalised advantage estimation: 1 waits for returns, 0 trusts values (paper: 0.95)."""
    clip_epsilon: float = 0.2
    """How far a decision's probability may move, as a ratio, before its gradient is cut (paper: 0.2)."""
    entropy_cost: float = 0.006
    """Weight of the entropy, which keeps actions random, in the loss (paper: 0.01)."""
    value_cost: float = 0.5
    """Weight of the value's squared error in the loss (paper: 0.5)."""
    max_gradient_norm: float = 0.5
    """Gradients longer than this are shortened to it (paper: 0.5)."""
    reward_scale: float = 0.01
    """Rewards are multiplied by this before learning (paper: 1)."""
    normalize_advantage: bool = True
    """Advantages of a batch are shifted and scaled to mean 0, deviation 1."""
    kl_stop: float = 0.03
    """A batch's epochs end early once the policy moved this far (approximate KL); 0 never stops."""
    kl_target: float = 0.0
    """The rate falls below its line while updates move the policy farther than this, and comes back; 0 never."""
    full_rate_inputs: int = 0
    """Dense layers with more inputs than this learn at the rate times this over their number; 0: all at the rate."""
    redraw_observations: bool = False
    """Keep scenes and poses in place of images and draw these again in every epoch: less memory, more rendering."""
    bootstrap_on_timeout: bool = False
    """Whether the last value stands in for what the time limit cut off; else it is an end like any other."""

    @property
    def decisions_per_update(self) -> int:
        """Decisions in one batch."""
        return self.num_envs * self.unroll_length

    def __post_init__(self) -> None:
        p = "ppo"
        require_types(self, p)
        for name in ("num_envs", "unroll_length", "num_minibatches", "num_epochs"):
            value = getattr(self, name)
            require(1 <= value <= 10**6, f"{p}.{name}", value, "in [1, 1000000]")
        batch, should = self.decisions_per_update, f"at most {LARGEST_BATCH}"
        require(batch <= LARGEST_BATCH, f"{p}.num_envs * unroll_length", batch, should)
        divides = self.num_envs % self.num_minibatches == 0
        should = f"a divisor of num_envs = {self.num_envs}, since minibatches are cut by environment"
        require(divides, f"{p}.num_minibatches", self.num_minibatches, should)
        require(0 < self.learning_rate <= 1, f"{p}.learning_rate", self.learning_rate, "in (0, 1]")
        for name in ("final_learning_rate_share", "discount", "gae_lambda"):
            value = getattr(self, name)
            require(0 <= value <= 1, f"{p}.{name}", value, "in [0, 1]")
        require(0 < self.clip_epsilon < 10, f"{p}.clip_epsilon", self.clip_epsilon, "in (0, 10)")
        norm, scale = self.max_gradient_norm, self.reward_scale
        require(0 < norm <= 1e9, f"{p}.max_gradient_norm", norm, "positive, and at most 1e9, which clips nothing")
        require(0 < scale <= 1e6, f"{p}.reward_scale", scale, "positive, and at most 1e6")
        for name in ("entropy_cost", "value_cost", "kl_stop", "kl_target"):
            value = getattr(self, name)
            require(0 <= value <= 1e9, f"{p}.{name}", value, "0 or more, and at most 1e9")
        inputs = self.full_rate_inputs
        require(0 <= inputs <= 10**9, f"{p}.full_rate_inputs", inputs, "in [0, 1e9]; 0 slows no layer down")


@dataclass(frozen=True)
class EvaluationConfig:
    """Held-out evaluation while training: on validation scenes, with deterministic actions."""

    every_decisions: int = 40_960
    """Training decisions between two evaluations (rounded up to whole updates)."""
    episodes: int = 200
    """Episodes of each."""
    num_slots: int = 64
    """Episodes that are driven at the same time; the scenes are the same for any number."""
    rocks: int | None = None
    """Rocks on the map; None: as many as env.scene.num_rocks. Where all policies reach every goal, none is the best."""

    def __post_init__(self) -> None:
        p = "evaluation"
        require_types(self, p)
        require(1 <= self.every_decisions <= 10**12, f"{p}.every_decisions", self.every_decisions, "in [1, 10^12]")
        require(1 <= self.episodes <= 10**7, f"{p}.episodes", self.episodes, "in [1, 10000000]")
        require(1 <= self.num_slots <= 10**5, f"{p}.num_slots", self.num_slots, "in [1, 100000]")
        require(self.rocks is None or self.rocks >= 0, f"{p}.rocks", self.rocks, "0 or more, or None")


RUN_TEST_SEED = 1
"""Of the test scenes at a run's end, whatever the run's seed: who compares settings by them leaves seed 0 unseen."""
BOOKKEEPING = (
    "run", "runs_dir", "resume", "loggers", "checkpoint_every_updates", "max_bad_updates", "num_seeds", "num_devices",
    "coordinator", "num_processes", "process_id",
)  # fmt: skip
"""Fields of ``TrainConfig`` that say where, how safely and on what a run is made, and not what is learnt."""


@dataclass(frozen=True)
class TrainConfig:
    """One training run: which policy learns, in which world and how, for how long, and where it is written."""

    arch: Arch = "cnn_lstm"
    """cnn_lstm, cnn: segmented images, with and without memory; cnn_lstm_raw: colour images; mlp: the true state;
    mlp_rocks: the true state and the nearest rocks."""
    preset: PresetName = "cpu"
    """Where the other defaults come from. paper: the paper's settings; cpu, gpu: tuned ones; smoke: everything once,
    tiny; auto, if not said: gpu where JAX has an accelerator, else cpu."""
    seed: int = 0
    """Of the first parameters, of training and validation scenes, and of all that is drawn; not of test scenes."""
    steps: int = 327_680
    """Training decisions in all (rounded up to whole updates)."""
    run: str = ""
    """Name of the run's folder; empty: made from arch, preset and seed."""
    runs_dir: str = RUNS_DIR
    """Where run folders go."""
    resume: bool = False
    """Go on from the run folder's last checkpoint."""
    start_from: str = ""
    """A policy's folder, or a shipped policy's name: training starts from its weights. Empty: from random ones."""
    num_seeds: int = 1
    """Runs that are trained at once, with seed, seed + 1, ..., each in a folder of its own: in one program, or in turn
    where policies that look are trained on a CPU."""
    num_devices: int = 1
    """Devices (of each process) that share the environments; the result is that of one, up to the order of sums."""
    coordinator: str = ""
    """HOST:PORT on which process 0 listens, where several processes train together."""
    num_processes: int = 1
    """Processes that train together, on one machine or many; all see runs_dir."""
    process_id: int = 0
    """Which of them this is, from 0."""
    checkpoint_every_updates: int = 8
    """Updates between two saves of everything that --resume needs."""
    max_bad_updates: int = 10
    """Updates in a row with a loss or gradient that is not finite (such steps are skipped), after which a run stops."""
    loggers: tuple[LoggerName, ...] = ()
    """wandb, mlflow: who gets the numbers besides metrics.jsonl and TensorBoard. Offline, unless WANDB_MODE or
    MLFLOW_TRACKING_URI say otherwise; each is an extra of the package."""
    env: EnvConfig = field(default_factory=EnvConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)

    @property
    def runs(self) -> tuple["TrainConfig", ...]:
        """The settings of each run: this one, or one for each of ``num_seeds``."""
        if self.num_seeds == 1:
            return (self,)
        seeds = range(self.seed, self.seed + self.num_seeds)
        return tuple(replace(self, seed=seed, run=f"{self.run_name}-seed{seed}", num_seeds=1) for seed in seeds)

    @property
    def run_name(self) -> str:
        """The run folder's name; of several seeds, what their folders' names begin with."""
        name = f"{self.arch}-{self.preset}"
        return self.run or (name if self.num_seeds > 1 else f"{name}-seed{self.seed}")

    @property
    def num_updates(self) -> int:
        """Updates that ``steps`` come to."""
        return -(-self.steps // self.ppo.decisions_per_update)

    def __post_init__(self) -> None:
        require_types(self)
        for logger in self.loggers:
            require_choice(logger, LoggerName, "loggers")
        require(len(set(self.loggers)) == len(self.loggers), "loggers", self.loggers, "each of them once")
        require(0 <= self.seed < 2**31, "seed", self.seed, "in [0, 2^31)")
        require(1 <= self.num_seeds <= 1024, "num_seeds", self.num_seeds, "in [1, 1024]")
        should = f"in [0, {2**31 - self.num_seeds}], so that every one of num_seeds = {self.num_seeds} is below 2^31"
        require(self.seed + self.num_seeds <= 2**31, "seed", self.seed, should)
        for name in ("steps", "checkpoint_every_updates", "max_bad_updates"):
            require(1 <= getattr(self, name) <= 10**12, name, getattr(self, name), "in [1, 10^12]")
        self._require_even_shares()
        is_name = "/" not in self.run and self.run not in (".", "..") and self.run == self.run.strip()
        is_name = is_name and len(self.run.encode()) <= LONGEST_NAME_BYTES
        should = (
            f"a folder's name without slashes, at most {LONGEST_NAME_BYTES} bytes long; --runs-dir says where it is"
        )
        require(is_name, "run", self.run, should)
        require(len(self.runs_dir) > 0, "runs_dir", self.runs_dir, "a folder; . is this one")
        for name in ("runs_dir", "start_from"):
            require(is_path(getattr(self, name)), name, getattr(self, name), A_PATH)
        self._require_room_for_validation_rocks()
        seen = ARCH_OBSERVATION[self.arch]
        require(self.env.obs == seen, "env.obs", self.env.obs, f"{seen} for arch {self.arch}")

    def _require_even_shares(self) -> None:
        require(self.num_processes >= 1, "num_processes", self.num_processes, "1 or more")
        for name in ("num_processes", "num_devices"):
            count = getattr(self, name)
            require(count <= MOST_DEVICES, name, count, f"at most {MOST_DEVICES}")
        should = f"in [0, {self.num_processes}), the number of processes"
        require(0 <= self.process_id < self.num_processes, "process_id", self.process_id, should)
        host, colon, port = self.coordinator.rpartition(":")
        is_port = port.isascii() and port.isdigit() and len(port) <= 5 and 0 < int(port) < 2**16
        is_address = bool(host and colon and is_port)
        if self.num_processes > 1 or self.coordinator:
            require(is_address, "coordinator", self.coordinator, "HOST:PORT of process 0")
        per_minibatch = self.ppo.num_envs // self.ppo.num_minibatches
        each = f", in {self.num_processes} processes" if self.num_processes > 1 else ""
        should = f"a divisor of the {per_minibatch} environments in a minibatch{each} (ppo.num_envs / num_minibatches)"
        is_share = self.num_devices >= 1 and per_minibatch % (self.num_devices * self.num_processes) == 0
        require(is_share, "num_devices", self.num_devices, should)
        alone = self.num_seeds == 1 or self.num_devices * self.num_processes == 1
        require(alone, "num_seeds", self.num_seeds, "1 where several devices or processes train")

    def _require_room_for_validation_rocks(self) -> None:
        rocks = self.evaluation.rocks
        if rocks is None:
            return
        try:
            replace(self.env.scene, num_rocks=rocks)
        except ConfigError as error:
            should = str(error).partition(": ")[2]
            raise ConfigError(f"evaluation.rocks = {rocks!r}: {should}") from None
