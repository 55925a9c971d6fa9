"""The live page as a user meets it, in a real browser."""

import numpy as np
from PIL import Image

from warp_rigid.viewer.overlays import JOINTS, OVERLAYS

SIX = ("box_stack", "leaning_tower", "incline", "plank_launch", "seesaw", "skull_and_brain")


def changed_pixels(before, after):
    return int((np.abs(before - after).max(axis=-1) > 12).sum())


def body(session, name):
    return next(i for i, body in enumerate(session.plan.scene.bodies) if body.name == name)


def test_keys_load_the_six_scenes_and_each_runs_and_is_drawn(stage):
    live = stage("seesaw")
    pictures = []
    for digit, name in enumerate(SIX, start=1):
        live.press(str(digit))
        live.until(lambda name=name: live.session.source == name, f"key {digit} loads {name}")
        live.until(lambda: live.session.time > 0.2, f"{name} runs")
        live.press("Space")
        live.until(lambda: not live.session.running, "Space pauses")
        live.until_shown("Scene", live.control("Scene").first)
        live.page.wait_for_timeout(300)
        picture = live.shot()
        assert picture.std(axis=(0, 1)).max() > 8.0, f"{name} shows a blank page"
        assert live.control("Scene").first.input_value() == name
        pictures.append(picture)
    for first in range(len(pictures)):
        for second in range(first):
            assert changed_pixels(pictures[first], pictures[second]) > 1000


def test_step_restart_and_speed(stage):
    live = stage("seesaw")
    start = live.session.sim.get("position").copy()
    live.press("Space")
    live.until(lambda: live.session.running, "it runs")
    live.press("n")
    live.until(lambda: not live.session.running, "a single step pauses")
    live.done()
    before = live.session.time
    live.press("n")
    live.until(lambda: live.session.time > before, "a step is done")
    assert abs(live.session.time - before - live.session.sim.settings.dt) < 1e-9
    live.press("r")
    live.until(lambda: live.session.time == 0.0, "R restarts")
    assert np.array_equal(live.session.sim.get("position"), start)
    live.type_number("Speed", 0.25)
    live.until(lambda: live.session.speed == 0.25, "the speed follows the slider")


def test_a_newcomer_sees_the_seesaw_fail_without_contact_processing(stage):
    live = stage("seesaw")
    live.choose("Variant", "no_contact")
    live.until(lambda: live.session.variant == "no_contact", "the variant is taken")
    assert live.session.sim.get("contact_iterations")[0] == 0
    live.type_number("Speed", 4)
    live.until(lambda: live.session.time > 4.0, "the demo is over")
    verdicts = {verdict.name: bool(verdict.passed[0]) for verdict in live.session.verdicts}
    assert verdicts == {"tips": True, "tips_back": False}
    live.until(lambda: "then left > 10 degrees: no" in live.page.inner_text("body"), "the page says that it failed")


def test_sliders_and_switches_change_the_physics(stage):
    live = stage("incline")
    sim = live.session.sim
    live.press("c")
    live.until(lambda: sim.get("contact_iterations")[0] == 0, "C turns contact processing off")
    live.press("c")
    live.until(lambda: sim.get("contact_iterations")[0] == 10, "and on again")
    live.press("o")
    live.until(lambda: not sim.get("collision_first")[0], "O turns the stages' order")
    live.press("e")
    live.until(lambda: not sim.get("edge_samples")[0], "E turns edge samples off")
    mode = sim.get("shock_propagation")[0]
    live.press("s")
    live.until(lambda: sim.get("shock_propagation")[0] != mode, "S takes the next way of shock propagation")
    live.type_number("Collision iterations", 17)
    live.until(lambda: sim.get("collision_iterations")[0] == 17, "the slider sets the iterations")
    live.choose("Steps per second", "480")
    live.until(lambda: abs(live.session.sim.settings.dt * 480.0 - 1.0) < 1e-12, "the time step changes")
    assert live.session.sim.get("collision_iterations")[0] == 17
    live.press("r")
    live.press("Space")
    live.tab("Bodies")
    live.type_number("Friction", 0.0)
    live.until(lambda: (live.session.sim.get("friction") == 0.0).all(), "friction is gone")
    block = live.session.sim.get("position")[0].copy()
    live.until(lambda: np.abs(live.session.sim.get("position")[0] - block).max() > 0.2, "the block slides")
    live.type_number("Gravity [m/s2]", 0)
    live.until(lambda: live.session.sim.get("gravity")[0, 2] == 0.0, "gravity is gone")


def test_click_pushes_the_body_that_is_hit_and_drag_pulls_it(stage):
    live = stage("seesaw")
    session = live.session
    small = body(session, "small")
    before = session.sim.get("linear_velocity")[0, small].copy()

    def hit():
        """Click; a page that is still loading may look from elsewhere than the viewer believes."""
        live.press("r")
        live.done()
        live.page.mouse.click(*live.on_screen(session.sim.get("position")[0, small]))
        live.page.wait_for_timeout(500)
        return live.viewer.chosen == (0, small)

    live.until(hit, "the click hits the body")
    live.until(lambda: np.abs(session.sim.get("linear_velocity")[0, small] - before).max() > 0.5, "the click pushes")
    live.tab("Touch")
    live.until(lambda: "pushed small with 10 N s" in live.page.inner_text("body"), "the page tells the impulse")
    live.press("r")
    # Paused: a slow page takes hold later than the mouse went down, and the body must still be there.
    x, y = live.on_screen(session.sim.get("position")[0, small])
    live.page.mouse.move(x, y)
    live.page.mouse.down()
    for part in range(12):
        live.page.mouse.move(x, y - 6.0 * part)
        live.page.wait_for_timeout(60)
    live.until(lambda: session.pull_ends is not None, "the drag holds the body")
    live.press("Space")
    live.until(lambda: session.sim.get("position")[0, small, 2] > 0.75, "the body is lifted")
    live.page.mouse.up()
    live.until(lambda: session.pull_ends is None, "letting go releases it")
    assert (session.sim.get("force") == 0.0).all()


def test_every_overlay_is_drawn_and_taken_off(stage):
    live = stage("plank_launch")
    live.press("Space")
    live.until(lambda: live.session.time > 1.2, "it runs")
    live.press("Space")
    live.until(lambda: not live.session.running, "it pauses")
    live.tab("Show")
    plain = live.still()
    for label in ("Wireframe", *(name for name in OVERLAYS if name != JOINTS)):
        check_overlay(live, plain, label)
    for coloring in ("level", "speed"):
        live.choose("Colours", coloring)
        live.until(lambda: changed_pixels(plain, live.shot()) > 100, f"bodies are coloured by {coloring}")
        live.choose("Colours", "body")
        live.until(lambda: changed_pixels(plain, live.shot()) < 10, "they have their own colours again")


def test_joints_are_drawn_and_taken_off(stage):
    live = stage("cradle")
    live.tab("Show")
    check_overlay(live, live.still(), JOINTS)


def check_overlay(live, plain, label):
    """An overlay changes the picture, and leaves nothing behind when it is switched off."""
    live.check(label)
    live.until(lambda: changed_pixels(plain, live.shot()) > 30, f"{label} is drawn")
    live.check(label)
    live.until(lambda: changed_pixels(plain, live.shot()) < 10, f"{label} is gone")


def test_slice_of_a_mesh(stage):
    live = stage("skull_and_brain")
    plain = live.still()
    live.tab("Slice")
    live.check("Show the signed distance")
    live.until(lambda: changed_pixels(plain, live.shot()) > 500, "the slice is drawn")
    shown = live.still()
    live.type_number("Position", 0.2)
    live.until(lambda: changed_pixels(shown, live.shot()) > 300, "the slice moves")


def test_closed_tab_two_tabs_and_a_reload_leave_the_server_alive(stage):
    live = stage("seesaw")
    second = live.open()
    live.until(lambda: len(live.viewer.server.get_clients()) == 2, "two tabs are served")
    live.press("Space")
    live.until(lambda: live.session.running, "the first tab runs it")
    second.keyboard.press("Space")
    live.until(lambda: not live.session.running, "the second tab pauses it")
    second.close()
    live.until(lambda: len(live.viewer.server.get_clients()) == 1, "the closed tab is gone")
    live.press("Space")
    live.page.reload()
    live.page.get_by_text("Restart").wait_for()
    live.until(lambda: len(live.viewer.server.get_clients()) == 1, "the reloaded page is back")
    before = live.session.time
    live.until(lambda: live.session.time > before + 0.3, "it runs on")
    live.page.wait_for_timeout(300)
    assert live.shot().std(axis=(0, 1)).max() > 8.0


def test_a_batch_shows_all_or_one_environment(stage):
    live = stage("seesaw", compare=True)
    assert len(live.viewer.rows) == live.session.sim.num_envs == 3
    live.tab("Bodies")
    live.type_number("Environments shown", 1)
    live.until(lambda: list(live.viewer.rows) == [0], "one is shown")
    live.type_number("First environment", 2)
    live.until(lambda: list(live.viewer.rows) == [2], "and the last one")
    live.type_number("Friction", 0.33)
    live.until(lambda: np.allclose(live.session.sim.get("friction")[2], 0.33), "a change applies to the one shown")
    live.until_shown("Friction", live.control("Friction").last)
    assert live.control("Friction").last.input_value() == "0.33"
    assert not np.allclose(live.session.sim.get("friction")[0], 0.33)


def test_page_has_its_name_and_waits_until_it_is_watched(stage):
    live = stage("seesaw")
    assert live.page.title() == "warp_rigid"
    assert live.page.locator("link[rel~=icon]").first.get_attribute("href").startswith("data:image/svg+xml")
    # Opened by a program, the session is paused; nothing went by while the page was loading.
    assert live.session.time == 0.0
    live.page.get_by_text("Keys", exact=True).click()
    live.page.get_by_text("contact processing on or off").wait_for()


def test_rewind_shows_the_past_and_running_continues_from_there(stage):
    live = stage("seesaw")
    live.press("Space")
    live.until(lambda: live.session.time > 1.5, "it runs")
    live.press("Space")
    live.until(lambda: not live.session.running, "it pauses")
    end, shown = live.session.time, live.still()
    live.type_number("Rewind [s]", -1)
    live.until(lambda: changed_pixels(shown, live.shot()) > 200, "the past is shown")
    assert live.session.time == end
    live.press("Space")
    live.until(lambda: live.session.running, "it runs on")
    live.until(lambda: live.session.time < end, "from the moment that was shown")
    live.until(lambda: live.session.time > end, "up to where it was, and further")
    live.check("Loop the last 20 s")
    live.until(lambda: not live.session.running and live.viewer.history.length > 1.0, "the loop pauses the simulation")
    end, first = live.session.time, live.shot()
    live.until(lambda: changed_pixels(first, live.shot()) > 200, "the loop is shown")
    assert live.session.time == end


def test_picture_and_film_are_downloaded(stage, page, tmp_path):
    live = stage("seesaw")
    live.press("Space")
    live.until(lambda: live.session.time > 0.5, "it runs")
    live.press("Space")
    for button, name in (("Picture", "seesaw.png"), ("Film", "seesaw.html")):
        with live.page.expect_download() as download:
            live.page.get_by_role("button", name=button, exact=True).click()
        assert download.value.suggested_filename == name
        download.value.save_as(tmp_path / name)
    picture = np.asarray(Image.open(tmp_path / "seesaw.png").convert("RGB"))
    assert picture.shape[0] > 300 and picture.std(axis=(0, 1)).max() > 8.0
    page.goto((tmp_path / "seesaw.html").as_uri())
    page.wait_for_selector("canvas")


def test_a_dropped_body_falls_onto_the_others_and_is_inspected(stage):
    live = stage("box_stack")
    live.tab("Touch")
    before = live.session.sim.num_bodies
    live.choose("New body", "sphere")
    live.page.get_by_role("button", name="Drop", exact=True).click()
    live.until(lambda: live.session.sim.num_bodies == before + 1, "there is one more body")
    live.until(lambda: "(Sphere, dynamic)" in live.page.inner_text("body"), "it is selected and described")
    start = live.session.sim.get("position")[0, -1, 2]
    live.press("Space")
    live.until(lambda: live.session.sim.get("position")[0, -1, 2] < start - 0.3, "it falls")


def test_scene_is_built_again_with_other_parameters(stage):
    live = stage("box_stack")
    before = live.session.sim.num_bodies
    live.tab("Scene")
    live.type_number("Height", 4)
    live.page.get_by_role("button", name="Restart with these").click()
    live.until(lambda: live.session.sim.num_bodies == before - 6, "the stack has four boxes")


def test_dragging_a_fixed_body_says_that_it_is_fixed(stage):
    live = stage("seesaw")
    x, y = live.on_screen(live.session.sim.get("position")[0, body(live.session, "pivot")])
    live.page.mouse.move(x, y)
    live.page.mouse.down()
    for part in range(8):
        live.page.mouse.move(x + 4.0 * part, y - 4.0 * part)
        live.page.wait_for_timeout(60)
    live.page.mouse.up()
    live.page.get_by_text("pivot: is static").first.wait_for()


def test_all_bodies_are_beside_the_panel(stage):
    """On a page that the panel narrows by half, every corner of every moving body is in view."""
    live = stage("seesaw")
    sim, box = live.session.sim, live.canvas()
    live.page.wait_for_timeout(2000)
    for index, data in enumerate(live.session.plan.scene.bodies):
        if data.motion == 2:
            lower, upper = np.asarray(data.shape.bounds)
            for corner in np.ndindex(2, 2, 2):
                point = sim.get("position")[0, index] + np.where(corner, upper, lower)
                x, y = live.on_screen(point)
                assert box["x"] < x < box["x"] + box["width"] and box["y"] < y < box["y"] + box["height"]
