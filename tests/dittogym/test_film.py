"""Films, filmstrips and replays of an episode."""

import base64
import io
import json
import re
import zlib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import cv2
import gymnasium
import numpy as np
import pytest
import torch
from PIL import Image
from tiny import SMALL

import dittogym
from dittogym.render.film import VideoUnavailable, write_film
from dittogym.render.frame import pace
from dittogym.render.recording import Recording, as_function


def wave(observation: np.ndarray) -> np.ndarray:
    """Contraction on the left, expansion on the right, of one robot or a batch."""
    across = np.linspace(1, -1, 8, dtype=np.float32)
    return np.broadcast_to(across, (*observation.shape[:-3], 2, 8, 8)).copy()


@pytest.fixture(scope="module")
def recording() -> Recording:
    """Twenty steps of KICK that take 0.2 s; one particle is lost on the way."""
    env = dittogym.TorchEnv(replace(dittogym.make_spec("kick"), horizon=20), 2, **SMALL | {"substeps": 100})
    film = env.film(wave, index=1, seed=3)
    film.shots[-1].x[5] = np.nan
    return film


def test_a_recording_is_the_episode(recording: Recording) -> None:
    env = dittogym.TorchEnv(replace(dittogym.make_spec("kick"), horizon=20), **SMALL | {"substeps": 100})
    observation, _ = env.reset(seed=4)  # element 1 of a batch of seed 3
    rewards = []
    for shot in recording.shots[:-1]:
        np.testing.assert_allclose(shot.x, env.state.x[0], atol=1e-6)
        observation, reward, *_ = env.step(torch.from_numpy(wave(observation.numpy())))
        rewards.append(float(reward))
    assert recording.rewards == pytest.approx(rewards, abs=1e-3) and recording.duration == pytest.approx(0.2)
    assert recording.success is False and np.array_equal(recording.observation, observation[0])
    assert recording.default_speed == 0.05  # 4 s


def test_what_cannot_be_written_is_not_played(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    monkeypatch.setattr("dittogym.render.film.find_spec", lambda name: None)
    env = dittogym.TorchEnv("kick", **SMALL)
    for path, options, error in (("film.mp4", {}, VideoUnavailable), ("film.gif", {"rate": 0}, ValueError)):
        with pytest.raises(error):
            env.film(lambda observation: pytest.fail("played"), tmp_path / path, **options)


@pytest.mark.parametrize("limit", [3, 50])
@pytest.mark.parametrize("single", [True, False])
def test_a_recording_stops_after_some_steps(limit: int, single: bool) -> None:
    spec = replace(dittogym.make_spec("kick"), horizon=5)
    env = dittogym.Env(spec, **SMALL) if single else dittogym.TorchEnv(spec, 2, **SMALL)
    film = env.film(wave, max_steps=limit)
    assert len(film.rewards) == len(film.shots) - 1 == min(limit, 5)


@pytest.mark.parametrize("suffix", ["gif", "webp", "mp4"])
def test_films(recording: Recording, tmp_path, suffix: str) -> None:
    if suffix == "mp4":
        pytest.importorskip("imageio_ffmpeg")
    path = recording.save(tmp_path / "new" / f"film.{suffix}", size=64, rate=10, speed=0.2)
    if suffix == "mp4":
        film = cv2.VideoCapture(str(path))
        count, shape = int(film.get(cv2.CAP_PROP_FRAME_COUNT)), film.read()[1].shape[:2]
        seconds = count / film.get(cv2.CAP_PROP_FPS)
        assert count == 21  # from 0 to 1 s, and the last picture a second longer
    else:
        with Image.open(path) as film:
            durations = []
            for number in range(film.n_frames):
                film.seek(number)
                film.load()
                durations.append(film.info["duration"])
            shape, seconds = film.size, sum(durations) / 1000
    assert shape == (64, 64) and seconds == pytest.approx(2.1)
    assert [each.name for each in path.parent.iterdir()] == [path.name]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # imageio leaves pipes open then
@pytest.mark.parametrize("says", ["exit 1", "[ $1 = -y ] && cat > /dev/null; exit 1"])
def test_an_ffmpeg_that_fails_is_named(tmp_path, monkeypatch: pytest.MonkeyPatch, says: str) -> None:
    """Also one that only fails once it has taken the whole film, as on a disk that is full by then."""
    pytest.importorskip("imageio_ffmpeg")
    program = tmp_path / "ffmpeg"
    program.write_text(f"#!/bin/sh\n{says}\n")
    program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    pictures = [np.zeros((512, 512, 3), np.uint8)] * 10
    with pytest.raises(VideoUnavailable, match="ffmpeg"):
        write_film(tmp_path / "film.mp4", pictures, 10.0)
    assert [file.name for file in tmp_path.iterdir()] == ["ffmpeg"]


def test_pictures_of_a_film(recording: Recording) -> None:
    """Muscles are shown unless one does not want them, and a moment between two steps lies between them."""
    red, plain = (recording.picture(0.1, muscles=muscles, size=128).astype(int) for muscles in (True, False))
    assert (red[..., 0] - red[..., 2] > 100).sum() > 50 > (plain[..., 0] - plain[..., 1] > 100)[:, :64].sum()
    first, second = recording.shots[10].x, recording.shots[11].x
    near = recording.picture(0.105)
    moved = recording.shots[10]._replace(x=(first + second) / 2)
    middle = replace(recording, shots=[moved]).picture(0.0)
    assert (np.abs(near.astype(int) - middle).max(-1) > 60).mean() < 0.01
    assert [pace(speed) for speed in (1, 0.05, 0.003, 0.3, 2)] == [
        "real time", "20 times slower", "333 times slower", "3.3 times slower", "2 times faster",
    ]  # fmt: skip


def test_a_caption_without_room_in_one_line_takes_two(recording: Recording) -> None:
    def dark(*caption: Any) -> np.ndarray:
        return (recording.picture(0.0, size=200, caption=caption) < 100).any(-1)

    left, right = "shapematch   12.34 s", "return 123.4   20 times slower"
    both, lines = dark(left, right), [dark(text, "")[:16] for text in (left, right)]
    assert np.array_equal(both[:32], np.concatenate(lines))
    assert np.array_equal(dark(left, "1.0")[:16, :130], lines[0][:, :130]) and not dark(left, "1.0")[16:32].any()


def test_filmstrip(recording: Recording, tmp_path) -> None:
    strip = np.asarray(Image.open(recording.save(tmp_path / "strip.png", size=64, pictures=3, zoom=1)))
    assert strip.shape == (64, 3 * 64 + 2, 3) and (strip[:, 64] == 255).all()
    assert np.array_equal(strip[16:, -64:], recording.picture(0.2, size=64, zoom=1)[16:])


def test_environments_of_gymnasium_film_too(tmp_path) -> None:
    env = gymnasium.make("dittogym/shapematch-coarse-v0", resolution=8, **SMALL).unwrapped
    assert env._repr_png_() is None
    recorded = env.film(wave, tmp_path / "film.html", seed=1)
    assert (tmp_path / "film.html").stat().st_size > 1000 and len(recorded.rewards) == 30
    assert "<iframe" in recorded._repr_html_() and env._repr_png_().startswith(b"\x89PNG")


def test_a_notebook_shows_all_robots_of_a_batch() -> None:
    batch = gymnasium.make_vec("dittogym/run-coarse-v0", num_envs=3, **SMALL)
    assert batch._repr_png_() is None
    batch.reset(seed=0)
    sheet = np.asarray(Image.open(io.BytesIO(batch._repr_png_())))
    assert sheet.shape == (1028, 1028, 3)  # two rows of two, with a line of two pixels after each
    for index, (row, column) in enumerate(((0, 0), (0, 514), (514, 0))):
        assert np.array_equal(sheet[row : row + 512, column : column + 512], batch.torch_env.render(index))
    assert (sheet[514:, 514:] == 255).all()


def test_a_film_is_repeatable_and_leaves_torch_s_generator_alone() -> None:
    env = dittogym.TorchEnv("shapematch", resolution=8, **SMALL)

    def noisy(observation: np.ndarray) -> torch.Tensor:
        return 2 * torch.rand(1, 2, 8, 8) - 1

    state = torch.get_rng_state()
    first = env.film(noisy, seed=3).rewards
    assert torch.equal(torch.get_rng_state(), state)
    assert env.film(noisy, seed=3).rewards == env.film(noisy, seed=[3]).rewards == first
    assert env.film(noisy, seed=4).rewards != first
    assert env.film(noisy, seed=None).rewards != env.film(noisy, seed=None).rewards


def test_policies_are_functions_or_predict() -> None:
    """With the memory that predict returns; deterministic if they were evaluated so in training."""

    class Telling:
        def predict(self, observation, state=None, episode_start=None, deterministic=False):
            return (deterministic, state), (state or 0) + 1

    policy, env = Telling(), dittogym.TorchEnv("kick", **SMALL)
    act = as_function(policy, env)
    assert [act(None), act(None)] == [(False, None), (False, 1)]
    policy.deterministic_by_default = True
    assert as_function(policy, env)(None) == (True, None)


def decode(page: str) -> tuple[dict, np.ndarray, dict[str, np.ndarray]]:
    """The description, the positions (T, 2, N) and the values (T, N) that a replay holds."""
    header = json.loads(re.search(r'type="application/json">(.*?)</script>', page, re.S)[1])
    data = zlib.decompress(base64.b64decode(re.search(r'type="text/plain">(.*?)</script>', page, re.S)[1]))
    moments, counts = len(header["steps"]), [body["count"] for body in header["bodies"]]
    size = moments * 2 * sum(counts)
    codes = np.frombuffer(data, np.uint8)
    alternating = codes[:size].astype(int) + 256 * codes[size : 2 * size].astype(int)
    second = np.where(alternating % 2, -(alternating + 1) // 2, alternating // 2).reshape(moments, 2, -1)
    quanta = np.cumsum(np.cumsum(second, 0), 0).astype(np.int16)
    positions = np.array(header["centre"])[:, :, None] + quanta * header["quantum"]
    values, start = {}, 2 * size
    for name, count in (("muscle", counts[0]), ("deformation", sum(counts))):
        part = codes[start : start + moments * count].reshape(moments, count)
        values[name] = np.cumsum(part, 0, dtype=np.uint8)
        start += part.size
    assert start == len(codes)
    return header, np.where(quanta == -(2**15), np.nan, positions), values


def test_a_replay_holds_the_episode(recording: Recording, monkeypatch) -> None:
    header, positions, values = decode(recording.page())
    assert header["steps"] == list(range(21)) and header["particles"] == positions.shape[2]
    for moment, shot in enumerate(recording.shots):
        distance = np.linalg.norm(positions[moment].T[:, None] - shot.x[None], axis=-1)
        known = np.isfinite(positions[moment]).all(0)
        assert known.sum() == np.isfinite(shot.x).all(1).sum()
        assert np.nanmin(distance[known], axis=1).max() < header["quantum"]  # each is one of them
    levels = header["levels"]
    assert values["muscle"][0].tolist() == [levels // 2] * header["bodies"][0]["count"]  # at rest
    assert values["muscle"][1].min() < levels / 3 and values["muscle"][1].max() > 0.6 * levels
    assert values["deformation"].max() > 0 and all(of.max() <= levels for of in values.values())
    monkeypatch.setattr("dittogym.render.replay.MOST_MOMENTS", 7)
    monkeypatch.setattr("dittogym.render.replay.MOST_PARTICLES", 50)
    header, positions, _ = decode(recording.page())
    assert header["steps"] == [0, 3, 6, 9, 12, 15, 18, 20] and header["stride"] == 3
    assert positions.shape[2] == 50 and header["particles"] > 100
    assert "http" not in recording.page().replace("http-equiv", "")  # nothing comes from elsewhere


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    """An empty page, on which no error occurs."""
    page, errors = browser.new_page(viewport={"width": 600, "height": 800}), []
    page.on("pageerror", lambda error: errors.append(str(error)))
    yield page
    page.close()
    assert not errors


def test_a_replay_plays_in_a_browser(recording: Recording, page: Any, tmp_path) -> None:
    """The page unpacks its data, plays, draws what a film shows, and in all colours, and says what it holds."""
    page.goto(recording.save(tmp_path / "replay.html").as_uri())
    page.wait_for_function("document.body.dataset.ready && Number(document.getElementById('time').value) > 0.01")
    page.click("#play")
    assert page.inner_text("#play") == "Play"
    page.locator("#time").fill("0.1")
    assert page.inner_text("#now").endswith("0.10 s") and page.inner_text("#return").startswith("return ")
    coded = page.evaluate("document.getElementById('scene').toDataURL().split(',')[1]")
    drawn = np.asarray(Image.open(io.BytesIO(base64.b64decode(coded))).convert("RGB")).astype(int)
    differs = np.abs(drawn - recording.picture(0.1, size=len(drawn))).max(-1)
    assert (differs > 40).mean() < 0.02  # as in a film, but for the labels
    pictures = set()
    for colour in ("muscle", "deformation", "speed"):
        page.select_option("#colour", colour)
        pictures.add(page.evaluate("document.getElementById('scene').toDataURL()"))
    assert len(pictures) == 3 and f"20 steps of 10 ms, return {sum(recording.rewards):.1f}." in page.inner_text(
        "#about"
    )
    before = page.evaluate("time.valueAsNumber")
    page.focus("#time")
    page.keyboard.press("ArrowRight")  # one step, of the slider, too
    assert page.evaluate("time.valueAsNumber") == pytest.approx(before + 0.01)


def test_a_replay_shows_what_has_gone_wrong(recording: Recording, page: Any, tmp_path) -> None:
    """A robot that has flown away, and rewards that are not numbers; also long names, and steps of part of a ms."""
    far = recording.shots[1]._replace(
        x=recording.shots[1].x * np.float32(1e30), centre=np.full(2, 1e27), view=np.zeros(2)
    )
    wrong = replace(
        recording,
        scene=replace(recording.scene, dt=3e-4, task="a_task_with_such_a_long_name_that_it_takes_two_lines"),
        shots=[recording.shots[0], far._replace(origin=np.full(2, 1e27))],
        rewards=[np.nan],
    )
    page.goto(wrong.save(tmp_path / "replay.html", speed=1.0).as_uri())
    page.wait_for_function("document.getElementById('play').textContent === 'Play' && document.body.dataset.ready")
    assert page.inner_text("#return") == "return NaN" and page.inner_text("#about").startswith("1 step of 0.3 ms")
    page.set_viewport_size({"width": 320, "height": 600})
    assert page.evaluate("document.documentElement.scrollWidth") == 320


def test_a_return_that_is_rounded_to_zero_has_no_sign(recording: Recording, page: Any, tmp_path) -> None:
    shots, small = recording.shots[:2], (-0.01, 0.01)
    films = [replace(recording, shots=shots, rewards=[reward]) for reward in small]
    saved = [film.save(tmp_path / "film.gif", size=256, rate=2).read_bytes() for film in films]
    assert saved[0] == saved[1]
    page.goto(films[0].save(tmp_path / "replay.html", speed=1.0).as_uri())
    page.wait_for_function("document.getElementById('play').textContent === 'Play' && document.body.dataset.ready")
    assert page.inner_text("#return") == "return 0.0"
