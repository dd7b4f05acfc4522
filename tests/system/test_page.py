"""The live page in a real browser: what it says is what `/metrics` says.

Where no Chromium is installed it is skipped, unless A2S_REQUIRE_BROWSER is set. With
A2S_WRITE_PICTURES the pictures of docs/ are written anew.
"""

import math
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from selenium import webdriver
from system_helpers import OFTEN, REACH, Start, metrics_port, scrape

from a2s.learner.page.history import History
from a2s.learner.page.server import Server

pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]

WaitFor = Callable[..., None]
DOCS = Path(__file__).parents[2] / "docs"
NUM_FIGURES = 8  # there is no evaluation
MIDNIGHT_S = 999_993_600.0  # 2001-09-09
WIDE, PHONE = (1280, 1500), (390, 844)


@pytest.fixture
def browser() -> Iterator[webdriver.Chrome]:
    """A headless Chromium that reaches nothing but this machine."""
    program, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if program is None or driver is None:
        assert "A2S_REQUIRE_BROWSER" not in os.environ, "no chromium, or no chromedriver"
        pytest.skip("no chromium and chromedriver here")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for argument in (
        "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
        "--disable-background-networking", "--disable-component-update", "--disable-sync",
        "--hide-scrollbars", f"--window-size={WIDE[0]},{WIDE[1]}",
    ):  # fmt: skip
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    service = webdriver.ChromeService(executable_path=driver)
    chrome = webdriver.Chrome(options=options, service=service)
    yield chrome
    chrome.quit()


def _texts(browser: webdriver.Chrome, selector: str) -> list[str]:
    script = "return [...document.querySelectorAll(arguments[0])].map((e) => e.textContent)"
    return list(browser.execute_script(script, selector))


def _figures(browser: webdriver.Chrome) -> dict[str, float]:
    """Every number that the page has from a metric, by its name."""
    script = """return Object.fromEntries([...document.querySelectorAll("[data-name]")]
        .filter((e) => e.dataset.value !== "").map((e) => [e.dataset.name, +e.dataset.value]))"""
    return dict(browser.execute_script(script))


def test_a_run_is_seen_as_it_is(
    start: Start, endpoint: str, wait_for: WaitFor, browser: webdriver.Chrome
) -> None:
    """Curves, a recovery with r and r*, an actor that dies, nothing that a checker finds."""
    learner = start(
        "learner", *REACH, *OFTEN, "--envs", "2", "--listen", endpoint, "--run-dir", "run",
        "--total-steps", "100000000", "--metrics-port", "0", "--n", "1",
    )  # fmt: skip
    actor = start("actor", "--connect", endpoint, "--metrics-port", "-1")
    wait_for(lambda: "/metrics" in learner.text(), "the metrics")
    page = f"http://127.0.0.1:{metrics_port(learner)}/"
    assert f"live page   {page}" in learner.text()
    browser.get(page)
    wait_for(lambda: "number" in "".join(_texts(browser, "#recoveries li")), "a recovery", 120.0)
    wait_for(lambda: "plays" in _texts(browser, "#actors td"), "an actor that plays")
    assert "Return of an episode" in _texts(browser, "#panels h2")
    assert _texts(browser, "#state") == ["1 run, live"]

    actor.process.send_signal(signal.SIGKILL)
    wait_for(lambda: "gone" in _texts(browser, "#actors tr.bad td"), "a dead actor in red")
    wait_for(lambda: any("actor 0 is gone" in x for x in _texts(browser, "#alerts .bad")), "alert")

    def agrees() -> bool:
        told, shown = scrape(metrics_port(learner)), _figures(browser)
        return len(shown) == NUM_FIGURES and shown == {name: told[name] for name in shown}

    wait_for(agrees, "the figures of /metrics")

    browser.refresh()
    wait_for(lambda: "number" in "".join(_texts(browser, "#recoveries li")), "what was before")
    for size, scheme in ((WIDE, "light"), (PHONE, "dark")):
        _look(browser, size, scheme)
        assert _violations(browser) == []
        width = browser.execute_script("return document.documentElement.scrollWidth")
        assert width <= size[0]
    assert learner.end() == 143
    wait_for(lambda: _texts(browser, "#state") == ["no learner answers"], "that it has gone")
    said: list[dict[str, Any]] = browser.get_log("browser")  # type: ignore[no-untyped-call]
    # A request that was under way when the learner ended fails in one of several ways.
    assert [x for x in said if "Failed to load resource: net::ERR_" not in x["message"]] == []


def _look(browser: webdriver.Chrome, size: tuple[int, int], scheme: str) -> None:
    """Give the window a size and a colour scheme; keep a picture where that is wanted."""
    metrics: dict[str, Any] = {"width": size[0], "height": size[1], "deviceScaleFactor": 1}
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride", {**metrics, "mobile": size == PHONE}
    )
    feature = {"name": "prefers-color-scheme", "value": scheme}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
    if "A2S_WRITE_PICTURES" in os.environ:
        (DOCS / f"live-page-{scheme}.png").write_bytes(browser.get_screenshot_as_png())


def _violations(browser: webdriver.Chrome) -> list[str]:
    """What axe-core finds fault with."""
    browser.execute_script((files("axe_core_python") / "axe.min.js").read_text())
    found = browser.execute_async_script(
        "const done = arguments[0]; axe.run().then((found) => done(found.violations))"
    )
    return [f"{each['id']}: {[n['html'] for n in each['nodes']]}" for each in found]


def _add(history: History, after_s: float, training: float, evaluation: float) -> None:
    """Add to an off-policy run a metric of its environment, seconds after midnight, UTC."""
    told = {"episode": training, "eval": evaluation}
    samples = {f'a2s_learner_{n}_info_mean{{metric="x"}}': v for n, v in told.items()}
    steps = {
        'a2s_learner_gradient_steps_total{network="q"}': 40.0,
        'a2s_learner_gradient_steps_total{network="policy"}': 20.0,
        "a2s_learner_updates_total": 2,
    }
    history.add(MIDNIGHT_S + after_s, samples | steps)


def test_times_are_of_the_day_and_legends_say_what_is_latest(
    wait_for: WaitFor, browser: webdriver.Chrome
) -> None:
    """As ISO 8601 writes them; a metric of an environment in training and in evaluations."""
    history = History("run")
    for second in range(-30, 30):
        _add(history, second, 0.5, 7.0 if second == 0 else math.nan)
    browser.execute_cdp_cmd("Emulation.setTimezoneOverride", {"timezoneId": "UTC"})
    legend = "#panels article:last-child .u-legend"
    with closing(Server([history], "127.0.0.1", 0, "--port")) as server:
        browser.get(f"http://127.0.0.1:{server.port}/")
        wait_for(lambda: "x, mean of episodes" in _texts(browser, "#panels h2"), "the panel")
        assert "Gradient steps40" in _texts(browser, "#runs dl div")  # and not updates, its rounds
        assert _texts(browser, f"{legend} .u-label") == ["time", "training", "evaluation"]
        assert _texts(browser, f"{legend} .u-value") == ["2001-09-09 00:00:29", "0.5", "7"]
        _add(history, 31, 0.75, math.nan)
        wait_for(lambda: "0.75" in _texts(browser, f"{legend} .u-value"), "what is new")
    shown = browser.execute_script(
        "return times(null, [-60, -30, 0, 30].map((s) => arguments[0] + s), 0, 0, 30)", MIDNIGHT_S
    )
    assert shown == ["23:59:00\n2001-09-08", "23:59:30", "00:00:00\n2001-09-09", "00:00:30"]
    assert browser.execute_script(
        "return times(null, [0, 300].map((s) => arguments[0] + s), 0, 0, 300)", MIDNIGHT_S
    ) == ["00:00\n2001-09-09", "00:05"]


def test_what_was_recovered_before_a_resume_is_no_recovery(
    wait_for: WaitFor, browser: webdriver.Chrome
) -> None:
    """The learner begins to serve before it knows its earlier count, and its target."""
    history = History("run")
    recoveries, target = "a2s_learner_recoveries_total", "a2s_learner_target_steps"
    for second, (count, steps) in enumerate([(0, 0), (3, 100), (4, 100)]):
        history.add(MIDNIGHT_S + second, {recoveries: count, target: steps})
    with closing(Server([history], "127.0.0.1", 0, "--port")) as server:
        browser.get(f"http://127.0.0.1:{server.port}/")
        wait_for(lambda: "number" in "".join(_texts(browser, "#recoveries li")), "a recovery")
        (told,) = _texts(browser, "#recoveries li")
    assert told.startswith("run: number 4 at")


def test_several_runs_are_seen_on_one_page(
    start: Start, wait_for: WaitFor, browser: webdriver.Chrome
) -> None:
    """From their metrics alone; one that does not answer is named."""
    options = ("learner", *REACH, "--metrics-port", "0")
    learners = [
        start(*options, "--run", n, "--run-dir", n, "--listen", f"unixsock-stream/{n}.sock")
        for n in ("first", "second")
    ]
    wait_for(lambda: all("/metrics" in learner.text() for learner in learners), "metrics")
    targets = [f"127.0.0.1:{metrics_port(learner)}" for learner in learners]
    dashboard = start("dashboard", *targets, "127.0.0.1:1", "--port", "0")
    wait_for(lambda: "http://" in dashboard.text(), "the page")
    browser.get(dashboard.text().split()[2])
    headings = "#runs h2"
    wait_for(lambda: "second: a2s on" in "".join(_texts(browser, headings)), "runs")
    assert "first: a2s on" in "".join(_texts(browser, headings))
    assert any("cannot be reached" in text for text in _texts(browser, "#alerts .bad"))
    assert dashboard.end(signal.SIGINT) == 130, dashboard.text()
