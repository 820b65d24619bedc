import shutil
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import msgspec
import pytest
from msgspec.structs import asdict
from playwright.sync_api import Page, sync_playwright

from jaxouter.evaluation import comparison_figures, report, scenarios, statistics
from jaxouter.evaluation.baselines import Kind
from jaxouter.evaluation.metrics import FiguresOfMerit, mae
from jaxouter.evaluation.policies import NamedPolicy, baseline, evaluate_on
from jaxouter.evaluation.results import (
    Comparison,
    GridErrors,
    LineSummary,
    Location,
    PolicyInfo,
    Row,
    StabilityRow,
    Summary,
    SweepErrors,
)
from jaxouter.evaluation.rollout import rollout
from jaxouter.evaluation.statistics import Line
from jaxouter.identification import steady_state
from jaxouter.plants import make
from jaxouter.tasks import Axis
from jaxouter.training.run import surroundings
from tests.precision import makes_nan

HOSTILE = "<script>alert(1)</script> $x_$.py"
SCENARIOS = ("pitch/paper", "pitch/steps")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


class Written(NamedTuple):
    """A report and what it was made of."""

    path: Path
    comparison: Comparison


def policies() -> dict[str, NamedPolicy]:
    hostile = NamedPolicy(HOSTILE, *steady_state.static(*make("pitch"), jax.random.key(1)), "pitch")
    return {"none": baseline("none", "pitch"), "static": baseline("static", "pitch"), HOSTILE: hostile}


def row(name: str, identifier: str, figures: FiguresOfMerit, limit: float) -> Row:
    assert figures.mae is not None
    within = figures.violation_time is not None and figures.violation_time <= 0.001
    return Row(name, None, None, identifier, figures.mae / limit, None, within, None, **asdict(figures))


def swept(named: NamedPolicy, axes: dict[str, list[float]]) -> GridErrors:
    """MAE on pitch/paper over one or two parameters."""
    scenario = scenarios.get("pitch/paper", 1)

    def error(**values: float) -> float:
        parameters = replace(scenario.params, **{name: jnp.full(1, value) for name, value in values.items()})
        with jax.debug_nans(False):  # with some of these delays it diverges
            return mae(rollout(named.policy, named.params, replace(scenario, params=parameters)))

    first, *rest = axes
    if not rest:
        return GridErrors([axes[first]], [error(**{first: v}) for v in axes[first]])
    grid = [[error(**{first: v, rest[0]: w}) for w in axes[rest[0]]] for v in axes[first]]
    return GridErrors(list(axes.values()), grid)


def sweep(
    named: dict[str, NamedPolicy], infos: dict[str, PolicyInfo], axes: dict[str, list[float]], nominal: float
) -> SweepErrors:
    every = tuple(Axis(name, "s", tuple(values), nominal) for name, values in axes.items())
    found = SweepErrors(every, {name: swept(each, axes) for name, each in named.items()})
    return msgspec.structs.replace(found, best_baseline=statistics.best_baseline(found, infos))


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Written:
    """Two scenarios, two sweeps, three policies, of which `static` stands in for the limit."""
    folder, named = tmp_path_factory.mktemp("report"), policies()
    kinds: dict[str, Kind] = {"none": "baseline", "static": "limit", HOSTILE: "user"}
    settings = {"name": HOSTILE, "gain": 3.0}
    infos = {name: PolicyInfo(kind, 1600, 0.1, settings, f"{HOSTILE} & more.") for name, kind in kinds.items()}
    chosen = [scenarios.get(name, 2) for name in SCENARIOS]
    results = {name: evaluate_on(each, chosen) for name, each in named.items()}
    limits = {identifier: found.figures.mae or 0.0 for identifier, found in results["static"].items()}
    rows = [
        row(name, identifier, figures, limits[identifier])
        for name, found in results.items()
        for identifier, (_, figures) in found.items()
    ]
    stability = [
        StabilityRow(point, None, None, radius, remark, policy=name, scenario="pitch/paper")
        for name, radius, remark in (("none", 0.99, ""), (HOSTILE, 1.01, HOSTILE))
        for point in (-5.0, 5.0)
    ]
    content = Comparison(
        plant="pitch",
        y_unit="crad",
        time_unit="s",
        family_seed=2024,
        date="2026-01-31",
        machine=surroundings(),
        policies=infos,
        rows=statistics.ranks(rows, infos),
        statistics=statistics.summarise(rows, infos),
        sweeps={
            "pitch/pilot-delay": sweep(named, infos, {"tau": [0.0, 0.5, 1.0]}, 0.5),
            "pitch/controller-delays": sweep(named, infos, {"d1": [0.0, 0.5], "d2": [0.0, 0.3, 0.6]}, 0.0),
        },
        stability=stability,
        seconds=1.0,
        command="python -m jaxouter.compare pitch",
        folder="",
    )
    responses = {
        scenario.id: comparison_figures.responses(
            folder / f"{i}.png", scenario, {name: results[name][scenario.id].traces for name in named}, list(named)
        )
        for i, scenario in enumerate(chosen)
    }
    figures = comparison_figures.draw(folder, content)
    return Written(report.write(folder / "report.html", content, figures, responses), content)


@pytest.fixture(scope="module")
def chromium(request):
    if CHROMIUM is None:
        absent = "there is no Chromium here to open the report in (Debian: apt-get install chromium)"
        if request.config.getoption("--all"):
            pytest.fail(absent)
        pytest.skip(absent)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM)
        yield browser
        browser.close()


@pytest.fixture(params=[pytest.param(1280, id="laptop", marks=pytest.mark.slow), pytest.param(390, id="phone")])
def page(request, chromium, written):
    """The report, opened; whatever the browser complains about or asks the network for fails the test."""
    context = chromium.new_context(viewport={"width": request.param, "height": 844})
    page, complaints, requests = context.new_page(), [], []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("dialog", lambda dialog: (complaints.append(dialog.message), dialog.dismiss()))
    page.on("request", lambda asked: requests.append(asked.url))
    page.goto(written.path.as_uri())
    yield page
    assert complaints == []
    assert written.path.as_uri() in requests
    assert [url for url in requests if url != written.path.as_uri() and not url.startswith("data:")] == []
    context.close()


def overflow(page: Page) -> int:
    return page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")


def test_every_picture_is_seen(page, written):
    images = page.locator("img").all()
    assert len(images) == 2 + len(written.comparison.sweeps) + 1 + 1  # errors, effort, sweeps, stability, response
    for image in images:
        assert image.is_visible()
        assert image.evaluate("image => image.complete && image.naturalWidth") > 100
        assert image.bounding_box()["width"] > 300
        assert image.get_attribute("alt")


def test_page_never_scrolls_sideways_but_its_wide_tables_do(page):
    assert overflow(page) == 0
    box = page.get_by_role("region", name="Figures of merit on pitch/paper")
    hidden = box.evaluate("box => box.scrollWidth - box.clientWidth")
    assert hidden > 0
    first = box.locator("tbody th").first
    before = first.bounding_box()["x"]
    box.evaluate("box => box.scrollLeft = 200")
    assert first.bounding_box()["x"] == pytest.approx(before, abs=1)


def test_scenario_is_chosen_with_the_keyboard(page):
    image, select = page.locator("#response"), page.get_by_label("Scenario", exact=True)
    before = image.get_attribute("src")
    assert page.get_by_role("region", name="Figures of merit on pitch/paper").is_visible()
    select.focus()
    page.keyboard.press("ArrowDown")
    assert select.locator("option:checked").inner_text() == "pitch/steps"
    assert image.get_attribute("src") != before
    assert "pitch/steps" in image.get_attribute("alt")
    image.evaluate("image => image.decode()")
    assert image.evaluate("image => image.naturalWidth") > 100
    assert page.get_by_role("region", name="Figures of merit on pitch/steps").is_visible()
    assert not page.get_by_role("region", name="Figures of merit on pitch/paper").is_visible()
    assert overflow(page) == 0


def test_a_click_on_a_scenario_shows_its_responses(page):
    before = page.locator("#response").get_attribute("src")
    page.locator("section#errors thead").get_by_role("link", name="steps").click()
    assert page.get_by_label("Scenario", exact=True).locator("option:checked").inner_text() == "pitch/steps"
    assert page.locator("#response").get_attribute("src") != before
    assert page.locator("#responses-title").evaluate("title => title.getBoundingClientRect().top") < 200
    assert overflow(page) == 0


def test_hostile_names_stay_text(page):
    assert page.evaluate("document.scripts.length") == 1
    assert page.locator("section#errors th", has_text=HOSTILE).count() == 1
    assert page.locator("section#policies td", has_text=f"{HOSTILE} & more.").count() == 3
    assert page.locator("section#stability li", has_text=HOSTILE).count() == 1


def test_errors_show_mae_or_ratio(page, written):
    cell = page.locator("section#errors tbody tr", has_text="none").locator("td").first
    found = next(r for r in written.comparison.rows if (r.policy, r.scenario) == ("none", "pitch/paper"))
    mae, ratio = report.figure(found.mae), report.ratio(found.ratio_to_limit)
    assert mae == "10.9"
    assert cell.inner_text().split() == [mae, ratio]
    page.get_by_label("MAE", exact=True).check()
    assert cell.inner_text().split() == [mae]
    page.get_by_label("ratio to the limit", exact=True).check()
    assert cell.inner_text().split() == [ratio]


def test_page_is_one_file_in_both_colour_schemes(chromium, written):
    inks = []
    for scheme in ("light", "dark"):
        page = chromium.new_page(color_scheme=scheme)
        page.goto(written.path.as_uri())
        colours = [page.evaluate(f"getComputedStyle(document.body).{name}") for name in ("color", "backgroundColor")]
        assert colours[0] != colours[1]
        assert page.locator("figure .box").first.evaluate("b => getComputedStyle(b).backgroundColor") == (
            "rgb(255, 255, 255)"
        )
        inks.append(colours[0])
        page.close()
    assert inks[0] != inks[1]


@makes_nan
def test_answer_says_who_is_best_and_how_far_from_the_limit(written):
    said = report.answer(written.comparison.statistics, 2)
    assert said.startswith(f"{HOSTILE} is the best on the whole: the lowest MAE within the limits in 2 of 2 scenarios")
    assert "(none, the next: 0, mean rank 2.00). Its MAE is " in said
    assert said.endswith(").")


def line(kind, mean_rank, first, unranked=0, ratios=()):
    found = {f"pitch/{i}": Location(value) for i, value in enumerate(ratios)}
    return LineSummary("", None, kind, 1, mean_rank, first, unranked, found, Location())


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (
            {"pi": line("baseline", 1.2, 3), "learned": line("learned", 1.8, 1, 2, (1.5, None, 1.1, 1.2))},
            "learned is not the best: the lowest MAE within the limits in 1 of 4 scenarios, mean rank 1.80 (pi, the "
            "best: 3, mean rank 1.20); it leaves the limits or diverges in 2. Its MAE is 1.20× the limit's in the "
            "median scenario, from 1.10× (2) to 1.50× (0); it diverged in 1.",
        ),
        (
            {"learned": line("learned", 1.0, 4)},
            "learned has the lowest MAE within the limits in 4 of 4 scenarios, mean rank 1.00; nothing else was "
            "ranked. How far it is from the limit is not known: the limit was not computed.",
        ),
        (
            {"learned": line("learned", 1.5, 2, ratios=(1.25,)), "pi": line("baseline", 1.5, 2)},
            "learned shares the first place: the lowest MAE within the limits in 2 of 4 scenarios, mean rank 1.50 "
            "(pi, its equal: 2, mean rank 1.50). Its MAE is 1.25× the limit's (0).",
        ),
    ],
)
def test_answer_in_every_case(lines, said):
    assert report.answer(Summary([], lines, {}), 4) == said


def acted(label: str, **columns: tuple[float, ...]) -> Line:
    """A line with these figures of merit on paper, steps and rest."""
    merits = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
    names = ("pitch/paper", "pitch/steps", "pitch/rest")
    nothing = dict.fromkeys(FiguresOfMerit.__struct_fields__)
    rows = {
        name: [Row(label, None, None, name, None, None, True, None, **nothing | found)]
        for name, found in zip(names, merits, strict=True)
    }
    return Line(label, label, None, "learned", rows)


def test_the_headline_tells_of_rest_effort_and_limits():
    own = acted("learned", swing=(9.0, 9.0, 0.004), r_tilde_tv=(20.0, 80.0, 10.0), violation_time=(0.0, 0.006, 0.001))
    calm = acted("lq", swing=(9.0, 9.0, 0.002), r_tilde_tv=(10.0, 40.0, 5.0), violation_time=(0.0, 0.0, 0.0))
    assert report.conduct(own, calm, "crad") == (
        "At rest its r̃ swings by 0.00400 crad (lq: 0.00200). It moves r̃ 2.00× as much as lq, and is outside the limits "
        "in up to 0.600 % of the steps (steps)."
    )
    assert report.conduct(calm, None, "1") == (
        "At rest its r̃ swings by 0.00200. It never leaves the limits where it does not diverge."
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (0.0, "0.00"),
        (0.04567, "0.0457"),
        (3.14159, "3.14"),
        (136.2, "136"),
        (999.7, "1,000"),
        (2e7, "2.00e+07"),
    ],
)
def test_figures_have_three_digits(value, text):
    assert report.figure(value) == text


def test_styles_hold_when_a_policy_is_added():
    names = ["learned a", "learned b", "pi", "x.py", "y.py", "oracle"]
    look = comparison_figures.styles(names)
    assert len({(style.color, str(style.ls)) for style in look.values()}) == len(names)
    assert comparison_figures.styles([*names, "z.py"]).items() >= look.items()
    assert comparison_figures.styles(["pi"])["pi"] == look["pi"]
