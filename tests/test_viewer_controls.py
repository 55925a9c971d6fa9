"""Controls that the page changes while the viewer is busy: no change is lost, and the panel shows what is in effect."""

import threading

import numpy as np
import pytest

from tests.test_viewer_security import Served, open_page, settle, until, update
from warp_rigid.viewer.live import LiveViewer
from warp_rigid.viewer.session import Session

PATIENCE = 30.0


@pytest.fixture(scope="module")
def served():
    session = Session("seesaw", device="cpu", compare=True)
    made = Served(LiveViewer(session, port=8750))
    yield made
    made.close()


@pytest.fixture
def page(served):
    with open_page(served) as opened:
        yield opened
    until(lambda: not served.viewer.server.get_clients())


@pytest.fixture
def gate(served, monkeypatch):
    """Holds the viewer up where it is about to show the values of the environments that were chosen."""
    panel, reached, go_on = served.viewer._panel, threading.Event(), threading.Event()
    refresh = panel.refresh

    def refresh_later(*arguments):
        reached.set()
        assert go_on.wait(PATIENCE)
        refresh(*arguments)

    monkeypatch.setattr(panel, "refresh", refresh_later)
    yield reached, go_on
    go_on.set()


def friction(served, env):
    return served.viewer.session.sim.get("friction")[env]


def show(served, page, first, count):
    """Show some environments; done once the panel has their values."""
    update(page, served.widget("shown_envs"), count)
    update(page, served.widget("first_env"), first)
    settle(served, page)
    assert served.viewer.rows.tolist() == list(range(first, first + count))


@pytest.mark.parametrize("busy", [False, True], ids=["idle", "busy"])
def test_change_while_other_environments_come_takes_effect_and_stays_on_the_panel(served, page, gate, busy):
    reached, go_on = gate
    go_on.set()
    show(served, page, 0, 1)
    before = friction(served, 0).copy()
    wanted = 0.31 if busy else 0.33
    go_on.clear()
    reached.clear()
    update(page, served.widget("first_env"), 2)
    assert reached.wait(PATIENCE)
    # The threads in which viser calls functions may all be taken.
    threads = served.viewer.server.gui._thread_executor
    leave = threading.Event()
    taken = [threads.submit(leave.wait, PATIENCE) for _ in range(threads._max_workers * busy)]
    update(page, served.widget("friction"), wanted)
    until(lambda: served.widget("friction").value == wanted)
    go_on.set()
    served.done()
    leave.set()
    for one in taken:
        one.result(PATIENCE)
    settle(served, page)
    assert friction(served, 2) == pytest.approx(wanted)
    assert served.widget("friction").value == wanted
    assert (friction(served, 0) == before).all()


def test_panel_shows_the_values_of_the_environment_that_comes(served, page):
    show(served, page, 1, 1)
    update(page, served.widget("friction"), 0.11)
    settle(served, page)
    show(served, page, 0, 1)
    shown = served.widget("friction").value
    assert shown != 0.11 and shown == pytest.approx(np.median(friction(served, 0)))
    show(served, page, 1, 1)
    assert served.widget("friction").value == 0.11
