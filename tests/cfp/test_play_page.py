"""The page in a real browser: what is shown, and what pointer, keys and buttons do to the simulation."""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from cfp.play.server import Server
from cfp.play.session import Session


class Played:
    """A page that is open, and the simulation behind it."""

    def __init__(self, browser: Any, width: int = 1280, task: str = "run", root_path: str = "") -> None:
        self.sessions: list[Session] = []
        self.server = Server(lambda: self._session(task), "secret", port=0, root_path=root_path)
        self.thread = threading.Thread(target=self.server.run, daemon=True)  # a test that fails may not close it
        self.thread.start()
        self.errors: list[str] = []
        self.page = browser.new_page(viewport={"width": width, "height": 800})
        self.page.on("console", lambda message: message.type == "error" and self.errors.append(message.text))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(self.server.address)
        self.until(lambda: self.page.evaluate("stats.frames") > 3)

    def _session(self, task: str) -> Session:
        self.sessions.append(Session(task, particles=400, substeps=20, resolution=8))
        return self.sessions[-1]

    @property
    def session(self) -> Session:
        return self.sessions[-1]

    def until(self, condition: Callable[[], Any], seconds: float = 120) -> None:
        """Wait for something that the page does."""
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, self.errors
            self.page.wait_for_timeout(20)

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Where in the window a point of the world is drawn, pixels."""
        return tuple(self.page.evaluate("([x, y]) => stats.place(x, y)", [x, y]))

    def pixel(self, x: float, y: float) -> list[int]:
        """Red, green and blue of the picture at a point of the world."""
        code = """([x, y]) => { const canvas = document.getElementById("scene"), box = canvas.getBoundingClientRect();
            const at = [(x - box.left) * canvas.width / box.width, (y - box.top) * canvas.height / box.height];
            return [...canvas.getContext("2d").getImageData(...at, 1, 1).data].slice(0, 3); }"""
        return self.page.evaluate(code, list(self.place(x, y)))  # type: ignore[no-any-return]

    def draw(self, *points: tuple[float, float]) -> None:
        """Draw a line on the pad."""
        box = self.page.locator("#paper").bounding_box()
        at = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in points]
        self.page.mouse.move(*at[0])
        self.page.mouse.down()
        for point in at[1:]:
            self.page.mouse.move(*point, steps=5)
        self.page.mouse.up()

    def close(self) -> None:
        self.server.stop()
        self.thread.join(10)
        self.page.close()


@pytest.fixture
def played(browser: Any) -> Iterator[Played]:
    played = Played(browser)
    yield played
    played.close()
    assert played.errors == []


def test_dragging_pulls_at_the_robot(played: Played) -> None:
    session, mouse = played.session, played.page.mouse
    start = session.env.env_state.centre[0].tolist()
    mouse.move(*played.place(*start))
    mouse.down()
    for step in range(10):
        mouse.move(*played.place(start[0], start[1] + 0.02 * step))
        played.page.wait_for_timeout(50)
    played.until(lambda: float(session.env.env_state.centre[0, 1]) > start[1] + 0.05)
    assert session.hand.tool == "pull" and played.page.evaluate("stats.latencies.length") > 0
    mouse.up()
    played.until(lambda: session.grip is None)
    played.until(lambda: float(session.env.env_state.centre[0, 1]) < start[1] + 0.03)  # falls down


def test_the_robot_is_drawn_where_it_is(played: Played) -> None:
    """Pixels on the robot, next to it and on the floor differ, and have the colours of what is there."""
    page = played.page
    page.click("#play")
    played.until(lambda: not played.session.playing)
    page.wait_for_timeout(300)
    x, y = played.session.env.env_state.centre[0].tolist()
    robot, air, floor = (played.pixel(x + dx, y + dy) for dx, dy in ((0, 0), (0.137, 0.1), (0.137, 0.1 - y)))
    assert max(robot) < 150 and min(air) > 240 and floor == [112, 119, 130]


def test_keys_and_brush(played: Played) -> None:
    page, session = played.page, played.session
    page.keyboard.press(" ")
    played.until(lambda: page.inner_text("#play") == "Play")  # the session itself says so within each step, too
    before = int(session.env.env_state.steps[0])
    page.keyboard.press(".")
    played.until(lambda: int(session.env.env_state.steps[0]) == before + 1)
    page.keyboard.press("4")
    x, y = session.env.env_state.centre[0].tolist()
    page.mouse.click(*played.place(x, y))
    played.until(lambda: session.painted.any())
    assert session.painted.sum() == 2 and session.painted[:, 3:5, 3:5].sum() == 2  # the cell next to the middle
    page.keyboard.press("r")
    played.until(lambda: int(session.env.env_state.steps[0]) == 0 and not session.painted.any())
    page.keyboard.down("ArrowRight")
    page.keyboard.press(".")
    played.until(lambda: session.direction == "right" and len(session.history.actions) == 1)
    page.keyboard.up("ArrowRight")
    played.until(lambda: session.direction is None)
    assert session.history.actions[0].any() and page.input_value("#colour") == "muscle"


def test_sliders_and_files(played: Played) -> None:
    page, session = played.page, played.session
    page.locator("#gravity").fill("-5")
    page.locator("#stiffness").fill("1")
    played.until(lambda: session.physics.get("gravity") == (0.0, 5.0) and session.physics.get("mu") == 1300.0)
    assert "μ = 1300 Pa" in page.inner_text("#matter")
    page.click("#default")
    played.until(lambda: session.physics == {})
    page.click("#play")
    with page.expect_download() as caught:
        page.click("#actions")
    with np.load(caught.value.path()) as saved:
        assert saved["actions"].shape[1:] == (2, 8, 8) and list(saved["touched"]) == ["other matter or gravity"]
    with page.expect_download() as caught:
        page.click("#moment")
    assert caught.value.suggested_filename.endswith(".pt") and page.is_enabled("#back")


def test_a_film_of_what_is_shown(played: Played) -> None:
    page = played.page
    page.click("#film")
    shown = page.evaluate("stats.frames")
    played.until(lambda: page.evaluate("stats.frames") > shown + 10)
    with page.expect_download() as caught:
        page.click("#film")
    film = cv2.VideoCapture(str(caught.value.path()))
    pictures = [picture for _ in range(3) if (picture := film.read()[1]) is not None]
    assert len(pictures) == 3 and np.ptp(pictures[-1]) > 100  # not one colour
    assert page.inner_text("#film") == "Film"


def test_a_drawn_robot(played: Played) -> None:
    page, session = played.page, played.session
    played.until(lambda: page.locator("#terms li").count() > 3)
    terms = page.inner_text("#terms").split("\n")[0]
    page.click("#draw")
    played.until(lambda: page.inner_text("#play") == "Play")
    paper = """() => { const { data } = document.getElementById("paper").getContext("2d").getImageData(0, 0, 256, 256);
        return data.filter((value, k) => k % 4 === 0 && value > 60).length; }"""
    outline = page.evaluate(paper)
    page.hover("#paper")
    brush = page.evaluate(paper)
    assert 100 < outline < 2000 and 20 < brush - outline < 400
    played.draw((0.5, 0.6), (0.75, 0.6))
    page.click("#use")

    def is_wide() -> bool:
        width, height = np.ptp(session.shot.x[:400], axis=0)
        return bool(width > 1.8 * height)

    played.until(is_wide)
    played.until(lambda: not page.is_visible("#pad") and page.inner_text("#play") == "Pause")
    played.until(lambda: page.inner_text("#step") != "0")
    assert page.inner_text("#terms").startswith(terms)


def test_a_drawing_that_is_refused_stays_until_it_fits(played: Played) -> None:
    page, session = played.page, played.session
    page.click("#draw")
    page.click("#use")  # nothing was drawn
    played.until(lambda: "body must be a picture" in page.inner_text("#hint"))
    for remedy in ("#thicken", "#shrink"):
        played.until(lambda: page.inner_text("#play") == "Play")
        before = session.env
        page.click("#wipe")
        assert not page.is_visible(remedy)
        played.draw((0.1, 0.5), (0.9, 0.5))
        page.click("#use")
        played.until(lambda: "thicken the drawing or scale it down" in page.inner_text("#hint"))
        assert session.env is before
        page.click(remedy)
        played.until(lambda: not page.is_visible("#pad"))
        shape, own = session.env.spec.robot.shape, session.own_spec.robot.shape
        assert shape.size[0] > (1.5 if remedy == "#thicken" else 3) * shape.size[1]
        assert (shape.area < 0.9 * own.area) == (remedy == "#shrink")
        page.click("#draw")


def test_a_dialog_stops_time(played: Played) -> None:
    page, session = played.page, played.session
    for before, button in (("Pause", "#help"), ("Play", "#draw")):
        played.until(lambda before=before: page.inner_text("#play") == before)
        page.click(button)
        played.until(lambda: page.inner_text("#play") == "Play")
        step = session.num_steps
        page.wait_for_timeout(200)
        assert session.num_steps == step
        page.keyboard.press("Escape")
        played.until(lambda before=before: page.inner_text("#play") == before)
        page.click("#play")


def test_a_simulation_that_has_failed_is_shown_as_it_was(played: Played) -> None:
    page, session = played.page, played.session
    page.click("#play")
    played.until(lambda: page.inner_text("#play") == "Play")
    page.wait_for_timeout(300)
    at = session.env.env_state.centre[0].tolist()
    place, colour = played.place(*at), played.pixel(*at)
    session.env.state.v.fill_(np.nan)
    page.click("#once")
    played.until(lambda: page.is_visible("#verdict"))
    page.wait_for_timeout(300)
    assert not np.isfinite(session.shot.x).any()
    assert played.pixel(*at) == colour and np.allclose(played.place(*at), place, atol=2)
    page.click("#reset")
    played.until(lambda: not page.is_visible("#verdict"))
    assert np.allclose(played.place(*at), place, atol=2)


def test_behind_a_proxy(browser: Any) -> None:
    """What the page loads, and the connection, are below its own path."""
    played = Played(browser, root_path="/user/me")
    assert "/user/me/?token=" in played.page.url and played.page.inner_text("#task") == "RUN"
    played.close()
    assert played.errors == []


def test_small_screens_and_the_end_of_the_program(browser: Any) -> None:
    played = Played(browser, width=390, task="shapematch")
    assert played.page.evaluate("document.documentElement.scrollWidth") <= 390
    assert played.page.inner_text("#task") == "SHAPE MATCH" and played.page.title() == "SHAPE MATCH · dittogym"
    assert played.page.locator("#what option").count() == 2 and played.page.input_value("#speed") == "0.1"
    for width in (1100, 900, 390):
        played.page.set_viewport_size({"width": width, "height": 800})
        places = [played.page.locator(name).bounding_box() for name in ("#numbers", "#legend")]
        (numbers, legend) = ((box["x"], box["y"], box["x"] + box["width"], box["y"] + box["height"]) for box in places)
        assert legend[0] >= numbers[2] or legend[1] >= numbers[3], f"they overlap at {width} pixels"
    played.page.click("#draw")
    assert played.page.evaluate("scrollY") > 0
    played.draw((0.5, 0.5), (0.5, 0.5))
    played.page.click("#use")
    played.until(lambda: played.page.evaluate("scrollY") == 0)  # the robot is in sight again
    played.server.stop()
    played.until(lambda: played.page.is_visible("#lost"))
    played.close()
    assert played.errors == []
