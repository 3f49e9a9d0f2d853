"""The pages in a real browser, without a network: what is drawn, and what a click does."""

import json
import re
import shutil
import tempfile
import time
from pathlib import Path

import pytest
from selenium.webdriver import Chrome, ChromeOptions
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from vinemap import paths

FLAGS = """--headless=new --no-sandbox --disable-quic --no-first-run --disable-background-networking
    --disable-component-update --disable-sync --use-angle=swiftshader --enable-unsafe-swiftshader""".split()
PATIENCE = 60


@pytest.fixture(scope="module")
def browser():
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (chromium and driver):
        pytest.skip("needs chromium and chromedriver: apt-get install chromium chromium-driver")
    options = ChromeOptions()
    options.binary_location = chromium
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        for flag in (*FLAGS, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        one = Chrome(options=options, service=Service(driver))
        try:
            yield one
        finally:
            one.quit()


@pytest.fixture
def open_page(browser):
    """Open a page at a size, wait until it is drawn; at the end it must have asked for and complained of nothing."""

    def open_it(path, width=1440, height=900, anchor=""):
        browser.get_log("browser"), browser.get_log("performance")
        how = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", how)
        browser.get("about:blank")
        browser.get(path.as_uri() + anchor)
        assert drawn(browser, "drawn") < 10_000
        return browser

    yield open_it
    said = [entry for entry in browser.get_log("browser") if entry["level"] != "INFO"]
    assert said == []
    asked = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    urls = {one["params"]["request"]["url"] for one in asked if one["method"] == "Network.requestWillBeSent"}
    assert {url.partition(":")[0] for url in urls} <= {"file", "data", "about", "chrome"}  # the last, its own new tab
    assert {Path(url.partition("#")[0]).suffix for url in urls if url.startswith("file:")} <= {".html"}


def until(condition):
    deadline = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < deadline, "it never came true"
        time.sleep(0.05)
    return found


def drawn(browser, what):
    """Milliseconds after which something was drawn."""
    script = "return performance.getEntriesByName(arguments[0]).map((mark) => mark.startTime)[0]"
    return until(lambda: browser.execute_script(script, what))


def column(browser, title, within="#table"):
    script = """
    const table = document.querySelector(arguments[1] + " table");
    const heads = [...table.tHead.rows[0].cells];
    const k = heads.findIndex((head) => head.textContent.startsWith(arguments[0]));
    const cells = [...table.tBodies[0].rows].map((row) => row.cells[k].textContent);
    return [heads[k].getAttribute("aria-sort"), cells];
    """
    return browser.execute_script(script, title, within)


def bring(browser, one):
    """Have something in the middle of the window, so that it can be clicked."""
    browser.execute_script("arguments[0].scrollIntoView({block: 'center', inline: 'center', behavior: 'instant'})", one)
    return one


def click_heading(browser, title, within="#table"):
    heads = browser.find_elements(By.CSS_SELECTOR, f"{within} thead button")
    bring(browser, next(one for one in heads if one.get_attribute("textContent").startswith(title))).click()


def selected(browser):
    return [row.text for row in browser.find_elements(By.CSS_SELECTOR, "#table tr[aria-current] th")]


def numbers(texts):
    return [float(text.replace("−", "-").replace(",", "")) for text in texts]


def page_of(flights, parcel):
    return paths.report(flights / "september" / parcel, parcel)


def test_a_click_on_a_heading_sorts_by_number(flights, open_page):
    browser = open_page(page_of(flights, "A"))
    for title in ("Volume", "Difference", "e1 y"):
        for direction, down in (("ascending", False), ("descending", True)):
            click_heading(browser, title)
            known, shown = column(browser, title)
            assert known == direction
            assert numbers(shown) == sorted(numbers(shown), reverse=down)
            assert len(set(shown)) > 1


def test_a_row_is_selected_everywhere(flights, open_page):
    browser = open_page(page_of(flights, "A"))
    assert selected(browser) == ["1 A"]
    hit = browser.find_element(By.CSS_SELECTOR, "path.hit[data-row='3']")
    bring(browser, hit)
    place = browser.execute_script(
        "const p = arguments[0], q = p.getPointAtLength(p.getTotalLength() / 3), m = p.getScreenCTM();"
        "return [q.x * m.a + m.e, q.y * m.d + m.f].map(Math.round)",
        hit,
    )
    mouse = {"x": place[0], "y": place[1]}
    browser.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": "mouseMoved", **mouse})
    hint = until(lambda: browser.find_elements(By.CSS_SELECTOR, ".about"))
    assert hint[0].text.startswith("3 A")
    for kind in ("mousePressed", "mouseReleased"):
        browser.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": kind, **mouse, "button": "left", "clickCount": 1})
    until(lambda: selected(browser) == ["3 A"])
    assert "row 3 A" in browser.find_element(By.CSS_SELECTOR, ".plot").get_attribute("aria-label")
    bring(browser, browser.find_element(By.ID, "after")).click()
    assert selected(browser) == ["4 A"]
    browser.execute_script("document.querySelectorAll('#table tbody th button')[0].click()")
    assert selected(browser) == ["1 A"]


def test_a_long_table_scrolls_to_the_selected_row(flights, open_page):
    browser = open_page(page_of(flights, "A"))
    browser.execute_script("document.querySelector('#table .scroll').style.maxHeight = '90px'")
    place = browser.execute_script("return scrollY")
    for _ in range(4):
        browser.execute_script("document.getElementById('after').click()")
    seen = "const r = e => e.getBoundingClientRect(), b = document.querySelector('#table .scroll');"
    seen += "const l = r(b.querySelector('[aria-current]')), h = r(b.querySelector('thead'));"
    assert browser.execute_script(seen + "return h.bottom <= l.top + 1 && l.bottom <= r(b).bottom + 1")
    assert browser.execute_script("return scrollY") == place
    for _ in range(4):
        browser.execute_script("document.getElementById('before').click()")
    assert browser.execute_script(seen + "return h.bottom <= l.top + 1 && l.bottom <= r(b).bottom + 1")


def test_keys_get_past_the_map_whatever_number_of_rows_it_has(flights, open_page):
    browser = open_page(page_of(flights, "A"))
    browser.find_element(By.ID, "map").send_keys(Keys.TAB)
    assert browser.switch_to.active_element.get_attribute("aria-label") == "Zoom in"
    chosen = browser.find_element(By.ID, "row")
    chosen.send_keys(Keys.ARROW_DOWN)
    assert selected(browser) == ["2 A"]


def test_the_address_names_a_row(flights, open_page):
    assert selected(open_page(page_of(flights, "A"), anchor="#row-5")) == ["5 A"]


def colours(browser, selector):
    """How many pixels of a canvas have each colour."""
    return browser.execute_script(
        """
        const canvas = document.querySelector(arguments[0]);
        const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d");
        copy.drawImage(canvas, 0, 0);
        const seen = new Map();
        for (const pixel of new Uint32Array(copy.getImageData(0, 0, canvas.width, canvas.height).data.buffer)) {
          seen.set(pixel, (seen.get(pixel) ?? 0) + 1);
        }
        return [...seen.values()];
        """,
        selector,
    )


def test_the_canopies_are_drawn_in_3d_when_they_come_into_view(flights, open_page):
    browser = open_page(page_of(flights, "A"))
    browser.execute_script("document.getElementById('space').scrollIntoView()")
    drawn(browser, "canopies")
    pixels = colours(browser, "#canopies-view canvas")
    assert max(pixels) < 0.9 * sum(pixels)
    assert len(pixels) > 50
    before = browser.execute_script("return document.querySelector('#canopies-view canvas').toDataURL()")
    browser.execute_script("document.getElementById('after').click()")
    until(
        lambda: browser.execute_script("return document.querySelector('#canopies-view canvas').toDataURL()") != before
    )


def test_map_and_plots_are_drawn(flights, open_page):
    browser = open_page(page_of(flights, "A"))
    for canvas in ("#map canvas", "#plots canvas"):
        pixels = colours(browser, canvas)
        assert len(pixels) > 20
        assert sum(pixels) - max(pixels) > 1000
    before = colours(browser, "#map canvas")
    browser.find_element(By.CSS_SELECTOR, "#quantity option[value=gaps]").click()
    until(lambda: colours(browser, "#map canvas") != before)


@pytest.mark.parametrize("page", ["A/A_report.html", "one/one_report.html", "meadow/meadow_report.html", "index.html"])
def test_a_phone_shows_the_page_in_its_width(flights, open_page, page):
    browser = open_page(flights / "september" / page, width=390, height=844)
    assert browser.execute_script("return document.documentElement.scrollWidth") == 390
    script = """
    return [...document.querySelectorAll("h1, h2, select, button, .figures dd")].every(
      (one) => one.closest(".scroll, [hidden], .along") || one.getBoundingClientRect().right <= 390,
    );
    """
    assert browser.execute_script(script)


def test_a_long_name_stays_within_a_phone(flights, open_page, tmp_path):
    page, name = page_of(flights, "A").read_text(encoding="utf-8"), "Vigna del parroco, dietro la chiesa"
    path = tmp_path / "long.html"
    path.write_text(page.replace(' A"', f' {name}"'), encoding="utf-8")
    browser = open_page(path, width=390, height=844)
    assert selected(browser) == [f"1 {name}"]
    assert browser.execute_script("return document.documentElement.scrollWidth") == 390


def test_a_parcel_without_rows_says_so(flights, open_page):
    browser = open_page(page_of(flights, "meadow"))
    assert "No vine row was found" in browser.find_element(By.ID, "rows").text
    assert not browser.find_element(By.ID, "space").is_displayed()
    assert browser.find_element(By.CSS_SELECTOR, "#map .leaflet-image-layer").is_displayed()


def test_the_survey_shows_parcels_and_changes(flights, open_page):
    browser = open_page(paths.index(flights / "september"))
    assert column(browser, "Parcel")[1] == ["A", "meadow", "nobody's", "one"]
    click_heading(browser, "Length")
    click_heading(browser, "Length")
    known, shown = column(browser, "Length")
    assert known == "descending"
    assert shown[-1] == "–"
    assert numbers(shown[:3]) == sorted(numbers(shown[:3]), reverse=True)
    assert "failed" in column(browser, "State")[1][-1]
    facts = browser.find_element(By.ID, "facts").text
    assert "june" in facts
    assert "4 rows stand as before, 1 new, 1 gone" in facts
    assert sorted(filter(None, column(browser, "Change", "#rows")[1])) == ["gone", "new"]
    links = {link.get_attribute("href") for link in browser.find_elements(By.CSS_SELECTOR, "#table a")}
    assert page_of(flights, "A").as_uri() in links
    bring(browser, browser.find_element(By.CSS_SELECTOR, "#rows a")).click()
    assert drawn(browser, "drawn")
    assert browser.find_element(By.ID, "title").text == "A"


def choose(browser, one, value):
    script = "const one = document.getElementById(arguments[0]); one.value = arguments[1];"
    browser.execute_script(script + "one.dispatchEvent(new Event('change'))", one, value)


def test_the_survey_shows_its_parcels_over_the_dates(flights, open_page):
    browser = open_page(paths.index(flights / "september"))
    plots = browser.find_elements(By.CSS_SELECTOR, "#plots button")
    assert [plot.text.split("\n")[0] for plot in plots] == ["A", "meadow", "one"]
    words = plots[0].find_element(By.CSS_SELECTOR, "svg").get_attribute("aria-label")
    june, september = numbers(
        re.fullmatch(r"A, height \(m\): 18 June 2026 (.+), 14 September 2026 (.+)", words).groups()
    )
    assert [june, september] == pytest.approx([1.8, 2.0], abs=0.06)
    before = colours(browser, "#map canvas")
    choose(browser, "quantity", "rows-height")
    until(lambda: colours(browser, "#map canvas") != before)
    assert "Rows: change of height, m" in browser.find_element(By.ID, "legend").text
    choose(browser, "to", "june")
    assert "on both of these dates" in browser.find_element(By.ID, "facts").text
    choose(browser, "from", "june")
    assert "two flights, not one" in browser.find_element(By.ID, "facts").text
    choose(browser, "to", "")
    assert "4 rows stand as before" in browser.find_element(By.ID, "facts").text
    bring(browser, plots[2]).click()
    assert plots[2].get_attribute("aria-pressed") == "true"
    assert browser.find_element(By.ID, "parcel").get_property("selectedOptions")[0].text == "one"


def test_a_parcel_shows_its_rows_over_the_dates(flights, open_page):
    browser = open_page(page_of(flights, "A"))
    _, shown = column(browser, "18 Jun", "#dates")
    assert len(shown) == 6
    names = [row.text for row in browser.find_elements(By.CSS_SELECTOR, "#dates tbody th")]
    assert [name.startswith("was ") for name in names] == [False] * 5 + [True]
    plots = browser.find_elements(By.CSS_SELECTOR, "#season-plots svg")
    assert len(plots) == 4
    assert plots[0].get_attribute("aria-label").startswith("1 A, height (m): 18 June 2026")
    browser.find_element(By.ID, "after").click()
    assert browser.find_elements(By.CSS_SELECTOR, "#dates tr[aria-current] th")[0].text == "2 A"
    before = colours(browser, "#map canvas")
    choose(browser, "quantity", "grown-height")
    until(lambda: colours(browser, "#map canvas") != before)
    assert browser.find_element(By.ID, "from").is_displayed()


def test_odd_words_are_shown_as_words(flights, open_page, tmp_path):
    folder = tmp_path / "s"
    folder.mkdir()
    odd = f"<img src=x onerror=alert(1)></script>{'/folder' * 30}"
    paths.survey_record(folder).write_text(json.dumps({"parcels": [{"parcel": odd, "state": "failed", "reason": odd}]}))
    from vinemap.product.pages.survey import write_index

    assert write_index(folder, "</title><script>alert(2)</script>")
    browser = open_page(Path(paths.index(folder)))
    assert column(browser, "Parcel")[1] == [odd]
    assert browser.find_element(By.ID, "title").text == "</title><script>alert(2)</script>"
    assert not browser.find_elements(By.TAG_NAME, "img")
    cell = browser.find_element(By.CSS_SELECTOR, "#table td.long")
    assert cell.get_property("scrollWidth") <= cell.get_property("clientWidth")
