"""Controls of the live page. They queue requests, which the viewer's thread executes."""

import math
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from warp_rigid import scenes
from warp_rigid.engine.settings import SHOCK_MODES
from warp_rigid.render.appearance import COLORINGS
from warp_rigid.scene.coefficients import COEFFICIENTS
from warp_rigid.viewer.controls import check_value
from warp_rigid.viewer.history import LENGTH
from warp_rigid.viewer.hud import Hud
from warp_rigid.viewer.overlays import OVERLAYS
from warp_rigid.viewer.session import Session
from warp_rigid.viewer.slicing import AXES

STEP_RATES = ("60", "120", "240", "480", "960")
CUSTOM = "changed by hand"
SPAWNED = ("box", "sphere", "capsule", "like the selected body")
VELOCITIES = ("linear_velocity", "angular_velocity")
PARAMETER_SPAN = 3
"""Upper end of the slider for a parameter of a scene, as a multiple of its default."""

SLIDERS = {"collision_iterations": (0, 40, 1), "contact_iterations": (0, 40, 1), "shock_iterations": (0, 8, 1)}
"""Smallest value, largest value and step of the sliders for settings."""

COEFFICIENT_STEPS = {name: 10.0 ** (math.floor(math.log10(c.typical_max)) - 2) for name, c in COEFFICIENTS.items()}
"""Steps of the sliders for coefficients."""

SWITCHES = {
    "collision_first": "Collisions before velocities",
    "edge_samples": "Edge samples",
    "warm_starting": "Warm starting",
    "sleeping": "Sleeping",
}


def parameter_range(default: float) -> tuple[float, float, float]:
    """Smallest value, largest value and step of the slider for a parameter of a scene; the scene checks the value.

    Args:
        default: of the parameter; an integer has whole steps.
    """
    far = PARAMETER_SPAN * default if default else 10 if isinstance(default, int) else 1.0
    step = 1 if isinstance(default, int) else 10.0 ** (math.floor(math.log10(abs(far))) - 2)
    return min(0, far), max(0, far), step


class Panel:
    """All controls beside the 3-D view.

    Args:
        viewer: the live viewer; `viewer.ask(action, *arguments)` lets its thread call an action.
    """

    def __init__(self, viewer):
        """Build the controls; `refresh` sets their values."""
        self._viewer = viewer
        self._gui = viewer.server.gui
        self._contact_iterations = 10
        self._widgets: dict[str, Any] = {}
        self._actions: dict[str, Callable[[Any], None]] = {}
        self._waiting: Counter[str] = Counter()  # changes by the page that are queued, per control
        self._add_player()
        self.hud = Hud(viewer.server)
        tabs = self._gui.add_tab_group()
        for label, fill in (
            ("Method", self._add_method),
            ("Bodies", self._add_bodies),
            ("Show", self._add_show),
            ("Touch", self._add_touch),
            ("Scene", self._add_scene),
            ("Slice", self._add_slice),
        ):
            with tabs.add_tab(label):
                fill()
        self._add_keys()

    def refresh(self, session: Session, env: int) -> None:
        """Set all controls to the values of one environment."""
        sim, widgets = session.sim, self._widgets
        # A file is on offer only if the command line, or a program, has opened it.
        known = dict.fromkeys((self._viewer.given, session.source, *scenes.names()))
        files = [source for source in known if source not in scenes.names()]
        self._options("scene", [*files, *scenes.names()], session.source)
        self._options("variant", [*session.variants, CUSTOM], None)
        self.show_variant(session)
        for name in SLIDERS:
            self._set(name, int(sim.get(name)[env]))
        if sim.get("contact_iterations")[env] > 0:
            self._contact_iterations = int(sim.get("contact_iterations")[env])
        self._set("contact_processing", bool(sim.get("contact_iterations")[env] > 0))
        for name in SWITCHES:
            self._set(name, bool(sim.get(name)[env]))
        self._set("shock_propagation", str(sim.get("shock_propagation")[env]))
        for name, step in COEFFICIENT_STEPS.items():
            value = round(round(float(np.median(sim.get(name)[env])) / step) * step, 9)
            widgets[name].max = max(COEFFICIENTS[name].typical_max, value)
            self._set(name, value)
        self._set("gravity", round(float(-sim.get("gravity")[env, 2]), 2))
        rate = f"{1.0 / sim.settings.dt:.6g}"
        self._options("dt", [*STEP_RATES, *({rate} - set(STEP_RATES))], rate)
        self._options("body", [f"{i} {body.name}" for i, body in enumerate(sim.scene.bodies)], None)
        self._show_parameters(session)
        several = sim.num_envs > 1
        for name, top in (("first_env", sim.num_envs - 1), ("shown_envs", sim.num_envs)):
            widgets[name].max = max(top, 2)
            widgets[name].visible = several
        self._set("first_env", int(self._viewer.rows[0]))
        self._set("shown_envs", len(self._viewer.rows))

    def choose_body(self, body: int) -> None:
        """Show which body is selected."""
        self._set("body", self._widgets["body"].options[body])

    def show_variant(self, session: Session) -> None:
        """Show whether the settings are still those of a variant."""
        self._set("variant", session.variant or CUSTOM)
        self._summary.content = _summary(session)

    def say(self, text: str) -> None:
        """A line below the push controls."""
        self._said.content = text

    def picture(self, image: np.ndarray | None) -> None:
        """The slice as a picture, (height, width, 3) uint8; None takes it away."""
        if image is not None:
            self._image.image = image
        self._image.visible = image is not None

    def flip(self, name: str) -> None:
        """Toggle a check box, as a click would."""
        self._widgets[name].value = not self._widgets[name].value
        self._changed(name, self._widgets[name].value)

    def next_shock_mode(self) -> None:
        """Select the next mode of shock propagation."""
        mode = SHOCK_MODES[(SHOCK_MODES.index(self._widgets["shock_propagation"].value) + 1) % len(SHOCK_MODES)]
        self._widgets["shock_propagation"].value = mode
        self._changed("shock_propagation", mode)

    def _add_player(self) -> None:
        viewer, gui = self._viewer, self._gui
        self._add(
            "scene", gui.add_dropdown("Scene", scenes.names(), hint="Keys 1 to 6 load the first six."), viewer.load
        )
        variants = gui.add_dropdown("Variant", (CUSTOM,), hint="Settings to compare; restarts the scene.")
        self._add("variant", variants, viewer.use_variant)
        self._add("side_by_side", gui.add_checkbox("All variants side by side", False), viewer.compare)
        self._summary = gui.add_markdown("")
        buttons = gui.add_button_group("", ("Run / Pause", "Step", "Restart"))
        actions = {"Run / Pause": viewer.toggle, "Step": viewer.single_step, "Restart": viewer.restart}
        buttons.on_click(lambda event: viewer.ask(actions[event.target.value]))
        speed = gui.add_slider("Speed", 0.05, 4.0, 0.05, 1.0, hint="Simulated time over wall-clock time.")
        self._add("speed", speed, lambda value: setattr(viewer.session, "speed", value))
        hint = "Shows the last 20 s; running continues from the moment that is shown."
        rewind = gui.add_slider("Rewind [s]", -LENGTH, 0.0, 0.05, 0.0, hint=hint)
        self._add("back", rewind, lambda value: viewer.rewind(-value))
        self._add("loop", gui.add_checkbox("Loop the last 20 s", False), viewer.loop)
        saves = gui.add_button_group("Save", ("Picture", "Film"), hint="Film: the last 20 s as a page of its own.")
        sending = {"Picture": viewer.send_picture, "Film": viewer.send_film}
        saves.on_click(lambda event: viewer.ask(sending[event.target.value], event.client_id))

    def _add_method(self) -> None:
        gui, change = self._gui, self._viewer.change
        processing = gui.add_checkbox("Contact processing", True, hint="Off: no contact iterations")
        self._add("contact_processing", processing, lambda on: self._iterate_contacts(on * self._contact_iterations))
        modes = gui.add_dropdown("Shock propagation", SHOCK_MODES)
        self._add("shock_propagation", modes, partial(change, "shock_propagation"))
        for name, span in SLIDERS.items():
            set_count = self._iterate_contacts if name == "contact_iterations" else partial(change, name)
            slider = gui.add_slider(_label(name), *span, span[0])
            self._add(name, slider, lambda value, set_count=set_count: set_count(int(value)))
        for name, label in SWITCHES.items():
            self._add(name, gui.add_checkbox(label, False), partial(change, name))
        rates = gui.add_dropdown("Steps per second", STEP_RATES, initial_value="240")
        self._add("dt", rates, lambda value: change("dt", 1.0 / float(value)))

    def _add_bodies(self) -> None:
        gui, viewer = self._gui, self._viewer
        for name, coefficient in COEFFICIENTS.items():
            hint = f"{coefficient}. The slider sets all bodies to this value and shows the median."
            span = (coefficient.lower, coefficient.typical_max, COEFFICIENT_STEPS[name])
            slider = gui.add_slider(_label(name), *span, coefficient.lower, hint=hint)
            self._add(name, slider, lambda value, name=name: viewer.change(name, float(value)))
        gravity = gui.add_slider("Gravity [m/s2]", -5.0, 25.0, 0.01, 9.81)
        self._add("gravity", gravity, lambda value: viewer.change("gravity", (0.0, 0.0, -float(value))))
        self._add("first_env", gui.add_slider("First environment", 0, 2, 1, 0), self._show_envs)
        self._add("shown_envs", gui.add_slider("Environments shown", 1, 2, 1, 1), self._show_envs)
        gui.add_markdown("Changes apply to the environments shown.")

    def _show_envs(self, _: int) -> None:
        self._viewer.show_envs(*(int(self._widgets[name].value) for name in ("first_env", "shown_envs")))

    def _add_show(self) -> None:
        gui, viewer = self._gui, self._viewer
        self._add("coloring", gui.add_dropdown("Colours", COLORINGS))
        self._add("wireframe", gui.add_checkbox("Wireframe", False))
        self._add("sleepers", gui.add_checkbox("Sleeping bodies transparent", True))
        for name in OVERLAYS:
            self._add(name, gui.add_checkbox(name, False), partial(viewer.overlay, name))
        hint = "Switch off on slow graphics hardware."
        self._add("shadows", gui.add_checkbox("Shadows", not viewer.fast, hint=hint))

    def _add_touch(self) -> None:
        gui = self._gui
        gui.add_markdown("Click a body to push it away from you; drag it to pull it.")
        hint = "Speed of a body that is hit at its centre."
        self._add("strength", gui.add_slider("Push [m/s]", 0.1, 20.0, 0.1, 2.0, hint=hint))
        self._said = gui.add_markdown("")
        self._inspected = gui.add_markdown("")
        self._add("spawned", gui.add_dropdown("New body", SPAWNED))
        drop = gui.add_button_group("", ("Drop",), hint="Drops it above the others, into every environment.")
        drop.on_click(lambda event: self._viewer.ask(self._viewer.spawn, self._widgets["spawned"].value))

    def _add_scene(self) -> None:
        self._gui.add_markdown("Parameters of the scene, which is built again with them. `--set` takes values beyond.")
        self._parameters = self._gui.add_folder("Parameters")
        self._inputs: dict[str, Any] = {}
        again = self._gui.add_button_group("", ("Restart with these",))
        again.on_click(lambda event: self._viewer.ask(self._restart_with_parameters))

    def _show_parameters(self, session: Session) -> None:
        """Make a control for each number and switch among the parameters of the scene, unless they are there."""
        known = {
            name: session.plan.parameters.get(name, value)
            for name, value in session.plan.demo.parameters.items()
            if isinstance(value, bool | int | float)
        }
        if list(known) != list(self._inputs):
            for widget in self._inputs.values():
                widget.remove()
            self._inputs = {}
            with self._parameters:
                for name in known:
                    default = session.plan.demo.parameters[name]
                    if isinstance(default, bool):
                        self._inputs[name] = self._gui.add_checkbox(_label(name), default)
                    else:
                        self._inputs[name] = self._gui.add_slider(_label(name), *parameter_range(default), default)
        for name, value in known.items():
            if not isinstance(value, bool):
                self._inputs[name].min = min(self._inputs[name].min, value)
                self._inputs[name].max = max(self._inputs[name].max, value)
            self._inputs[name].value = value

    def _restart_with_parameters(self) -> None:
        self._viewer.restart_with({name: widget.value for name, widget in self._inputs.items()})

    def inspect(self, session: Session, env: int, body: int) -> None:
        """Show the values of the selected body."""
        sim, data = session.sim, session.plan.scene.bodies[body]
        speed, spin = (float(np.linalg.norm(sim.get(name)[env, body])) for name in VELOCITIES)
        contacts = sim.contacts()
        own = contacts[(contacts["env"] == env) & ((contacts["body_a"] == body) | (contacts["body_b"] == body))]
        place = ", ".join(f"{value:.3f}" for value in sim.get("position")[env, body])
        self._inspected.content = (
            f"**{data.name}** ({type(data.shape).__name__}, {data.motion.name.lower()}), "
            f"{float(sim.get('mass')[env, body]):.3g} kg\n\n"
            f"at ({place}) m, {speed:.3g} m/s, {spin:.3g} rad/s\n\n"
            f"{len(own)} contacts, {'asleep' if sim.get('asleep')[env, body] else 'awake'}"
        )

    def reset_time(self) -> None:
        """Show that the page shows the present."""
        self._set("back", 0.0)
        self._set("loop", False)

    def _add_slice(self) -> None:
        gui = self._gui
        self._add("slice", gui.add_checkbox("Show the signed distance", False))
        bodies = gui.add_dropdown("Body", ("0",), hint="Clicking a body also selects it.")
        self._add("body", bodies, lambda value: self._viewer.choose(int(value.split()[0])))
        self._add("axis", gui.add_dropdown("Plane across", AXES, initial_value="y"))
        hint = "From one end of the body to the other."
        self._add("place", gui.add_slider("Position", 0.0, 1.0, 0.01, 0.5, hint=hint))
        self._image = gui.add_image(np.zeros((2, 2, 3), np.uint8), label="signed distance", visible=False)

    def _add_keys(self) -> None:
        viewer = self._viewer
        commands = {
            "Run or pause": ("space", viewer.toggle),
            "Single step": ("N", viewer.single_step),
            "Begin again": ("R", viewer.restart),
            "Contact processing on or off": ("C", partial(self.flip, "contact_processing")),
            "Next way of shock propagation": ("S", self.next_shock_mode),
            "Stage order": ("O", partial(self.flip, "collision_first")),
            "Edge samples on or off": ("E", partial(self.flip, "edge_samples")),
            "Wireframe": ("W", partial(self.flip, "wireframe")),
        }
        for digit, name in zip("1234567890", scenes.names(), strict=False):
            commands[f"Load {name}"] = (digit, partial(viewer.load, name))
        lines = "\n".join(f"- **{key}** {label[0].lower()}{label[1:]}" for label, (key, _) in commands.items())
        with self._gui.add_folder("Keys", expand_by_default=False):
            self._gui.add_markdown(lines)
        for label, (key, action) in commands.items():
            command = self._gui.add_command(label, hotkey=key)
            command.on_trigger(lambda event, action=action: viewer.ask(action))

    def _add(self, name: str, widget: Any, action: Callable[[Any], None] | None = None) -> None:
        """Add a control: `action` executes a change of its value, in the viewer's thread; None for an option."""
        self._widgets[name], self._actions[name] = widget, action or partial(self._viewer.option, name)

        # A coroutine is called before the program can set the control again; a function would be called later.
        @widget.on_update
        async def _(event) -> None:
            # What the program sets itself comes back without a client.
            if event.client is not None:
                self._waiting[name] += 1
                self._viewer.ask(self._execute, name, widget.value)

    def _execute(self, name: str, value: Any) -> None:
        """Execute a queued change by the page."""
        with self._viewer.server.inputs:
            self._waiting[name] -= 1
        self._changed(name, value)

    def _changed(self, name: str, value: Any) -> None:
        """Execute the request of a control; called by the viewer's thread.

        Raises:
            ValueError: The control does not offer the value, or no longer does: another scene may have come meanwhile.
        """
        check_value(self._widgets[name], value)
        self._actions[name](value)

    def _iterate_contacts(self, count: int) -> None:
        """Set the contact iterations; 0 switches contact processing off."""
        self._contact_iterations = count or self._contact_iterations
        self._set("contact_iterations", count)
        self._set("contact_processing", count > 0)
        self._viewer.change("contact_iterations", count)

    def _set(self, name: str, value: Any) -> None:
        """Show a value, unless the page has changed it meanwhile: the change is queued and will take effect."""
        with self._viewer.server.inputs:
            if not self._waiting[name] and self._widgets[name].value != value:
                self._widgets[name].value = value

    def _options(self, name: str, options: list[str], value: str | None) -> None:
        widget = self._widgets[name]
        if tuple(widget.options) != tuple(options):
            widget.options = tuple(options)
        if value is not None:
            self._set(name, value)


def _label(name: str) -> str:
    return name.replace("_", " ").capitalize()


def _summary(session: Session) -> str:
    """Summary of the scene, and the changes of its variant."""
    demo = session.plan.demo
    changes = session.variants.get(session.variant or "", {})
    changed = ", ".join(f"{name} = {value}" for name, value in changes.items())
    return f"*{demo.summary}*" + (f"\n\n{session.variant}: {changed}" if changed else "")
