"""First paint of the live page: python benchmarks/page.py [--rounds 9].

Serves two hours of a run's history, opens the page in a headless Chromium, and writes when
something was painted first, when all of it was there, and how many bytes came. Needs chromium and
chromedriver.
"""

import argparse
import math
import shutil
import statistics
import sys
from contextlib import closing

from selenium import webdriver

from a2s.learner.page.history import EVERY_S, History
from a2s.learner.page.server import Server

_HISTORY_S = 7200
_FOUND = """
const paint = performance.getEntriesByName("first-contentful-paint")[0];
const files = performance.getEntriesByType("resource");
const page = performance.getEntriesByType("navigation")[0];
const bytes = files.concat(page).reduce((sum, each) => sum + each.transferSize, 0);
return [paint ? paint.startTime : null, page.loadEventEnd, bytes];
"""


def two_hours() -> History:
    """A run whose numbers change with every sample."""
    history, now_s = History("run"), 1e9
    for second in range(0, _HISTORY_S, int(max(1, EVERY_S))):
        value = 1000.0 * math.sin(second / 600.0)
        names = ("return_mean", "env_steps_total", "policy_kl", "eval_return_mean")
        history.add(now_s + second, {f"a2s_learner_{name}": value for name in names})
    return history


def browser() -> webdriver.Chrome:
    """A headless Chromium with nothing in its cache."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run"):
        options.add_argument(argument)
    service = webdriver.ChromeService(executable_path=shutil.which("chromedriver"))
    return webdriver.Chrome(options=options, service=service)


def main() -> None:
    """Measure, each round in a browser of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    paints, loads = [], []
    rounds = parser.parse_args().rounds
    with closing(Server([two_hours()], "127.0.0.1", 0, "--port")) as server:
        for _ in range(rounds):
            chrome = browser()
            chrome.get(f"http://127.0.0.1:{server.port}/")
            found: list[float] = []
            while not found or found[0] is None or not found[1]:
                found = chrome.execute_script(_FOUND)
            paints.append(found[0])
            loads.append(found[1])
            chrome.quit()
    for name, times in (("first paint", paints), ("loaded", loads)):
        middle = statistics.median(times)
        sys.stdout.write(
            f"{name}: {middle:.0f} ms, {min(times):.0f} to {max(times):.0f}, {rounds} rounds\n"
        )
    sys.stdout.write(f"bytes over the wire before the history: {found[2]:.0f}\n")


if __name__ == "__main__":
    main()
