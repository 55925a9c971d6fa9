"""Search: Optuna's proposals are simulated a batch at a time."""

import numpy as np
import pytest

import warp_rigid as wr
from tests.test_sweep import ball
from warp_rigid.sweep import batch_run as batch_module


def test_a_speed_is_found_from_where_the_ball_ended(monkeypatch):
    """The ball flies speed * time far, so that the speed that hits the mark is known."""
    sizes, inner = [], batch_module._run
    monkeypatch.setattr(
        batch_module, "_run", lambda job, made, *rest: sizes.append(len(made.runs)) or inner(job, made, *rest)
    )

    def miss(row):
        return abs(row["final_position"][3] - 0.15)

    options = {"trials": 40, "batch": 10, "duration": 0.1, "device": "cpu", "metrics": ["final_pose"]}
    study = wr.search(ball, {"speed": wr.Uniform(0, 3), "mass": [1.0, 2.0]}, miss, **options)
    assert sizes == [10] * 4 and len(study.trials) == 40
    assert study.best_params["speed"] == pytest.approx(1.5, abs=0.1)
    again = wr.search(ball, {"speed": wr.Uniform(0, 3), "mass": [1.0, 2.0]}, miss, **options)
    assert again.best_params == study.best_params
    wr.search(ball, {"speed": wr.Uniform(0, 3), "mass": [1.0, 2.0]}, miss, study=study, **options | {"trials": 5})
    assert len(study.trials) == 45


def test_failed_runs_are_failed_trials_and_metrics_objectives():
    axes = {"speed": wr.LogUniform(1, 2), "count": wr.Integers(1, 2)}
    options = {"trials": 4, "batch": 4, "duration": 0.02, "device": "cpu", "fixed": {"mass": 1e-3}}
    study = wr.search(ball, axes, "drift", direction="maximize", **options)
    assert study.best_value == pytest.approx(max(t.values[0] for t in study.trials))
    options["fixed"]["force[ball]"] = (3e38, 0.0, 0.0)
    study = wr.search(ball, axes, "drift", **options)
    assert {trial.state.name for trial in study.trials} == {"FAIL"}


def test_an_objective_that_no_row_has_is_refused_before_any_run(monkeypatch):
    axes, options = {"speed": [1.0]}, {"trials": 1, "duration": 0.02, "device": "cpu"}
    with pytest.raises(ValueError, match="^column: must be a column, got 'outcome_none'; "):
        wr.search("box_stack", {"height": [1]}, "outcome_none", metrics=["drift", "outcome"], **options)
    monkeypatch.setattr(batch_module, "_run", lambda *_, **__: pytest.fail("it ran"))
    for objective in ("drfit", "outcome_error"):
        with pytest.raises(ValueError, match=f"^objective: must be a column, got '{objective}'; .*names: "):
            wr.search(ball, axes, objective, **options)


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="speed: must be a list, Uniform"):
        wr.search(ball, {"speed": wr.Normal(1, 1)}, "drift")
    with pytest.raises(ValueError, match="direction: must be"):
        wr.search(ball, {"speed": np.array([1, 2])}, "drift", direction="up")
    for arguments, message in (({"seed": -1}, "seed: must be"), ({"axes": {}}, "axes: must have at least one axis")):
        with pytest.raises(ValueError, match=message):
            wr.search(ball, **{"axes": {"speed": [1.0]}, "objective": "drift", **arguments})
