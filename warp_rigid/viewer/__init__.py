"""The viewer in the browser: a client of the public Simulator, which does not depend on it.

`session` plays a scene (no browser in it), `live` shows it, `playback` shows films and writes them as a page of their
own. The other modules draw one thing each. Needs the extra `viewer` (viser).
"""
