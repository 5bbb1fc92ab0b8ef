"""Tests of the browser page: bitwise states, buttons, controllers, errors, frame rate."""

import base64
import json
import shutil
import subprocess
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest

from baselines.mlp import MlpPolicy
from baselines.pd import PDPolicy
from baselines.policies import pretrained_file
from docs.browser import build, emission, scenes
from docs.extensions import browser_page
from quad_gym.analysis.metrics import nees, state_error

KEY, STEPS, EVERY = 7, 500, 25
FIELDS = ("r", "v", "q", "w", "rotor_speeds", "b_g", "r_hat", "v_hat", "R_hat", "b_a_hat", "P")
BUTTONS = {100: "gnss", 150: "gust", 250: "bias", 375: "camera", 450: "bias"}
NOISE_AT, LATENCY_AT = 300, 350
"""Steps before which the sliders change: noise times 2, and latency times 1.5."""
NOISES = ("position_sigma_I", "velocity_sigma", "baseline_sigma", "pixel_sigma", "aid_sigma")
MISSING = [*emission.missing_tools(), *([] if shutil.which("chromium") else ["chromium"])]
pytestmark = [
    pytest.mark.slow,  # the kernels are compiled for WebAssembly, and a browser starts
    pytest.mark.skipif(bool(MISSING), reason=f"the page needs {', '.join(MISSING)}"),
]

SCRIPT = Path(__file__).with_name("browser_page.js")


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """Return the page's report after ten seconds in each scene, and its console messages."""
    folder, received = tmp_path_factory.mktemp("page"), []

    class Receiver(BaseHTTPRequestHandler):
        def do_POST(self):
            received.append(self.rfile.read(int(self.headers["Content-Length"])))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *args):
            pass

    server = HTTPServer(("127.0.0.1", 0), Receiver)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    given = (STEPS, EVERY, FIELDS, BUTTONS, NOISE_AT, LATENCY_AT)
    address = f"http://127.0.0.1:{server.server_port}/"
    constants = f"const SEED = {KEY}, FLOWN = {json.dumps(given)}, ADDRESS = {address!r};"
    script = f"<script>\n{constants}\n{SCRIPT.read_text()}</script>\n</body>"
    file, log = folder / "fly.html", folder / "console.txt"
    file.write_text(build.page().replace("</body>", script))
    options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"]
    command = ["chromium", *options, f"--user-data-dir={folder / 'profile'}", file.as_uri()]
    with (
        open(log, "w") as stream,
        subprocess.Popen(command, stdout=stream, stderr=stream) as browser,
    ):
        try:
            for _ in range(1200):
                if received or browser.poll() is not None:
                    break
                threading.Event().wait(0.1)
        finally:
            browser.terminate()
            server.shutdown()
    assert received, log.read_text()[-2000:]
    found = json.loads(received[0])
    assert "failed" not in found, found["failed"]
    return {
        **found,
        "console": [line for line in log.read_text().splitlines() if "CONSOLE" in line],
    }


@pytest.fixture(scope="module")
def replayed(reported):
    """Fly in Python with the actions, buttons and sliders of the page."""
    return {name: replay(name, flight["actions"]) for name, flight in reported["flights"].items()}


def replay(name, actions):
    batch, biased = scenes.batch_of(name), False
    observations, rows, errors = [batch.reset(keys=scenes.keys_of(KEY))], [], []
    for i, action in enumerate(actions):
        button = BUTTONS.get(i)
        if button in ("gnss", "camera") and getattr(batch.sensors, button) is not None:
            batch.switch_sensors(**{button: False})  # until the flight ends
        if button == "bias":
            biased = not biased
            batch.switch_faults(biased)
        if button == "gust":
            batch._blocks["disturbance"][:, 0] = 3.0
        if BUTTONS.get(i - 50) == "gust":
            batch._blocks["disturbance"][:, 0] = 0.0
        if i == NOISE_AT:
            for field in NOISES:
                batch._own[0][field] *= 2.0
        if i == LATENCY_AT:
            delay(batch, 1.5)
        observations.append(batch.step(np.array(action)))
        if (i + 1) % EVERY == 0:
            parts = [batch.record(field).reshape(3, -1) for field in FIELDS]
            rows.append(np.concatenate(parts, axis=1))
            errors.append(nees(error_of(batch), batch.covariance()))
    return np.array(rows), np.array(observations), np.array(errors)


def delay(batch, factor):
    """Multiply the latencies; measurements that have arrived do not arrive again."""
    settings = batch._settings[0]
    before = settings["sensor_delay"].copy()
    settings["sensor_delay"] = np.round(factor * before)
    periods = settings["sensor_ticks"].clip(1)
    settings["under_way"] = np.ceil(settings["sensor_delay"] / periods)
    stamps = batch._blocks["stamps"][:, :, :, 0]
    arrived = batch._blocks["tick"][:, None, None] - stamps >= before[:, None, None]
    stamps[arrived & (before > 0)[:, None, None]] = np.nan


def error_of(batch):
    names = ("position", "velocity", "R_BI", "accel_bias", "gyro_bias")
    return state_error(
        {name: batch.read(name) for name in names},
        {name: batch.read(f"estimated_{name}") for name in names},
    )


def aloft(flight):
    """Return the number of steps of each controller without a crash."""
    return [STEPS if over is None else round(over["time"] * 50) - 1 for over in flight["over"]]


@pytest.mark.parametrize("name", scenes.SCENES)
def test_browser_flight_of_ten_seconds_equals_python_bitwise(reported, replayed, name):
    rows = replayed[name][0]
    flown = [np.frombuffer(base64.b64decode(row)) for row in reported["flights"][name]["rows"]]
    assert rows.shape[:2] == (STEPS // EVERY, 3)
    assert np.isfinite(rows).all()
    np.testing.assert_array_equal(np.array(flown).reshape(rows.shape), rows)


@pytest.mark.parametrize("name", scenes.SCENES)
def test_plotted_nees_equals_nees_of_package(reported, replayed, name):
    for k, steps in enumerate(aloft(reported["flights"][name])):
        plotted = [row[k] for row in reported["flights"][name]["nees"][: steps // EVERY]]
        expected = replayed[name][2][: steps // EVERY, k]
        np.testing.assert_allclose(plotted, expected, rtol=1e-6)


@pytest.mark.parametrize("name", ["circle", "look_around"])
def test_controllers_give_same_actions_as_in_package(reported, replayed, name):
    flight, observations = reported["flights"][name], replayed[name][1]
    actions = np.array(flight["actions"])
    env = gymnasium.make("QuadGym/Circle-v0", sensors=scenes.SCENES[name].sensors)
    controllers = {0: PDPolicy(env)}
    if name == "circle":
        controllers[1] = MlpPolicy.load(pretrained_file("QuadGym/Circle-v0", "pretrained:truth"))
        controllers[2] = MlpPolicy.load(pretrained_file("QuadGym/Circle-v0"))
    for k, controller in controllers.items():
        steps = aloft(flight)[k]
        expected, _ = controller.predict(observations[:steps, k])
        np.testing.assert_allclose(actions[:steps, k], expected, atol=1e-5)


def test_policy_in_look_around_observes_direction_and_standard_deviation(reported):
    actions = np.array(reported["flights"]["look_around"]["actions"])[:NOISE_AT, 2]
    policy = MlpPolicy.load(pretrained_file("QuadGym/LookAround-v0"))
    env = gymnasium.make_vec(
        "QuadGym/LookAround-v0",
        num_envs=1,
        task="baselines.arm_tasks:WithStd",
        start="hover",
        duration=0.0,
    )
    batch, observation = env.unwrapped.flights.batch, None
    observation = batch.reset(keys=scenes.keys_of(KEY)[:1])
    for action in actions[:100]:  # before any button
        expected, _ = policy.predict(observation[0])
        np.testing.assert_allclose(action, expected, atol=1e-4)
        observation = batch.step(action[np.newaxis])


def test_policy_trained_on_truth_crashes_and_pretrained_policy_does_not(reported):
    over = reported["flights"]["look_around"]["over"]
    assert over[1] is not None
    assert over[2] is None


def test_console_has_no_message(reported):
    assert reported["console"] == reported["errors"] == []


def test_page_flies_in_real_time(reported):
    """Limits are wide, because the browser has no graphics hardware and the machine is busy."""
    assert len(reported["frames"]) > 20
    assert np.median(reported["frames"]) < 50.0  # [ms]; 16.7 are available
    assert reported["flown"] > 0.5


def test_page_is_one_file_without_references_to_others():
    text = build.page()
    assert "http" not in text.split("<script>")[0].replace("<!doctype html>", "")
    assert 'src="' not in text
    assert len(text) < 700_000


def test_site_has_page_or_explanation_if_tools_are_missing(tmp_path, monkeypatch):
    app = SimpleNamespace(builder=SimpleNamespace(format="html"), outdir=tmp_path)
    (tmp_path / "_static").mkdir()
    browser_page.write_page(app, None)
    written = tmp_path / "_static" / "fly.html"
    assert written.read_text() == build.page()
    monkeypatch.setattr(browser_page, "missing_tools", lambda: ["ziglang"])
    browser_page.write_page(app, None)
    assert "a machine without ziglang" in written.read_text()
