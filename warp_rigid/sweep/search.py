"""Search over parameters: Optuna proposes, a sweep answers, a whole batch at a time."""

from collections.abc import Callable, Mapping
from typing import Any, Literal

from warp_rigid.checks import one_of, whole_in
from warp_rigid.sweep.axes import Choice, Distribution, Integers, LogUniform, Uniform, clean_axes
from warp_rigid.sweep.columns import FINISHED
from warp_rigid.sweep.run import sweep

__all__ = ["search"]


def search(
    scene: Any,
    axes: Mapping[str, Any],
    objective: str | Callable[[dict[str, Any]], float],
    *,
    trials: int = 256,
    batch: int = 32,
    direction: Literal["minimize", "maximize"] = "minimize",
    study: Any = None,
    seed: int = 0,
    **options: Any,
) -> Any:
    """Look for the parameters that make an objective least or greatest.

    Args:
        scene: as in `sweep`.
        axes: what may vary, by name: Uniform, LogUniform, Integers, Choice, or a list of values to choose from.
        objective: name of a metric, or a function of a row.
        trials: runs in all.
        batch: runs that are proposed, and simulated, at once.
        direction: "minimize" or "maximize".
        study: an optuna Study to go on with; None makes one, which samples by TPE.
        seed: of the sampler of a new study.
        **options: of `sweep`, such as duration, fixed, metrics and device.

    Returns:
        The optuna Study; `study.best_params` are the parameters found. A run that failed is a failed trial.

    Raises:
        ValueError: An axis or option is out of range.
    """
    import optuna

    one_of("direction", direction, ("minimize", "maximize"))
    whole_in("trials", trials, 1, 10_000_000)
    whole_in("batch", batch, 1, 10_000_000)
    whole_in("seed", seed, 0, 2**32 - 1)
    space = {name: _as_optuna(name, axis) for name, axis in clean_axes(axes).items()}
    if not space:
        raise ValueError("axes: a search needs at least one")
    if study is None:
        # Proposals of one batch know nothing of each other's results: the liar keeps them apart.
        sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=True, n_startup_trials=min(batch, trials))
        study = optuna.create_study(direction=direction, sampler=sampler)
    value = objective if callable(objective) else (lambda row: row[objective])
    done = 0
    while done < trials:
        asked = [study.ask(space) for _ in range(min(batch, trials - done))]
        points = {name: [trial.params[name] for trial in asked] for name in space}
        result = sweep(scene, points, design="zip", batch=len(asked), **options)
        for trial, row in zip(asked, result.rows, strict=True):
            measured = value(row) if row["status"] in FINISHED else None
            if measured is None:
                study.tell(trial, state=optuna.trial.TrialState.FAIL)
            else:
                study.tell(trial, float(measured))
        done += len(asked)
    return study


def _as_optuna(name: str, axis: list | Distribution) -> Any:
    """An axis as a distribution of Optuna's."""
    from optuna import distributions

    if isinstance(axis, list):
        return distributions.CategoricalDistribution(axis)
    if isinstance(axis, Choice):
        return distributions.CategoricalDistribution(axis.values)
    if isinstance(axis, Integers):
        return distributions.IntDistribution(axis.low, axis.high)
    if isinstance(axis, Uniform | LogUniform):
        return distributions.FloatDistribution(axis.low, axis.high, log=isinstance(axis, LogUniform))
    raise ValueError(f"{name}: a search needs a list, Uniform, LogUniform, Integers or Choice, got {axis!r}")
