"""Parameter search: Optuna proposes batches of parameters, and sweeps evaluate them."""

from collections.abc import Callable, Mapping
from typing import Any, Literal

from warp_rigid.checks import one_of, shown, suggestion, whole_in
from warp_rigid.runs.user_code import column_name
from warp_rigid.sweep.axes import Choice, Distribution, Integers, LogUniform, Uniform, clean_axes
from warp_rigid.sweep.columns import COLUMNS, FINISHED
from warp_rigid.sweep.execution import sweep
from warp_rigid.sweep.metrics import OUTCOME, check_metrics, check_observers


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
    """Search for the parameters that minimize or maximize an objective.

    Args:
        scene: as in `sweep`.
        axes: search space by name: Uniform, LogUniform, Integers, Choice, or a list of values.
        objective: name of a metric, or a function of a row.
        trials: total number of runs.
        batch: number of runs proposed and simulated together.
        direction: "minimize" or "maximize".
        study: an optuna Study to continue; None creates one with a TPE sampler.
        seed: seed of the sampler of a new study.
        **options: options of `sweep`, such as duration, fixed, metrics and device.

    Returns:
        The optuna Study; `study.best_params` are the best parameters. A failed run is a failed trial.

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
        raise ValueError("axes: must have at least one axis")
    names = map(column_name, (*check_metrics(options.get("metrics")), *check_observers(options.get("observe"))))
    known = (*names, *COLUMNS)
    # The columns of an outcome are known after the first batch.
    if not (callable(objective) or objective in known or (OUTCOME in known and str(objective).startswith(OUTCOME))):
        raise ValueError(f"objective: must be a column, got {shown(objective)}{suggestion(objective, known)}")
    if study is None:
        # The constant liar spreads the proposals of a batch, whose results are not yet known.
        sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=True, n_startup_trials=min(batch, trials))
        study = optuna.create_study(direction=direction, sampler=sampler)
    value = objective if callable(objective) else (lambda row: row[objective])
    done = 0
    while done < trials:
        proposed = [study.ask(space) for _ in range(min(batch, trials - done))]
        points = {name: [trial.params[name] for trial in proposed] for name in space}
        result = sweep(scene, points, design="zip", batch=len(proposed), **options)
        if not callable(objective):
            result.column(objective)
        for trial, row in zip(proposed, result.rows, strict=True):
            measured = value(row) if row["status"] in FINISHED else None
            if measured is None:
                study.tell(trial, state=optuna.trial.TrialState.FAIL)
            else:
                study.tell(trial, float(measured))
        done += len(proposed)
    return study


def _as_optuna(name: str, axis: list | Distribution) -> Any:
    """Convert an axis to an Optuna distribution."""
    from optuna import distributions

    if isinstance(axis, list | Choice):
        return distributions.CategoricalDistribution(axis if isinstance(axis, list) else axis.values)
    if isinstance(axis, Integers):
        return distributions.IntDistribution(axis.low, axis.high)
    if isinstance(axis, Uniform | LogUniform):
        return distributions.FloatDistribution(axis.low, axis.high, log=isinstance(axis, LogUniform))
    raise ValueError(f"{name}: must be a list, Uniform, LogUniform, Integers or Choice, got {axis!r}")
