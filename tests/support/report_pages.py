"""What the tests of report pages share: a small campaign, what its page says, a browser."""

from contextlib import contextmanager
from dataclasses import replace
from functools import cache

from hilcal.campaign.campaign import Campaign
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile
from hilcal.write_report import ReportOptions, content_of
from tests.support.campaigns import campaign, configuration

EVIL = "<script>window.harmed = 1</script>"
ALLOWED = ("file:", "data:", "blob:")


def write_campaign(path, poses=6):
    """A campaign in which joints tilt; one pose and one load have names that look like markup."""
    measured = campaign("joint_tilt_compliance", "deflection", poses=poses, strength=8.0).readings
    names = (f"{EVIL}1", *measured.pose_names[1:])
    loads = (*measured.load_names[:-1], f'"><img src=x onerror="window.harmed = 2">{EVIL}')
    content = configuration().to_json()
    with CampaignFile.create(path, content, str(configs_dir() / "cells"), EVIL) as file:
        file.append_readings(replace(measured, pose_names=names, load_names=loads))


@cache
def small_content(folder):
    """The content of a page on that campaign, without a revision, with limit and appendix."""
    path = folder / "a&<b>.hilcal"
    write_campaign(path)
    with Campaign.open(path) as run:
        return content_of(run, ReportOptions(limit_m=1e-3, operator=EVIL, appendix=True))


@contextmanager
def opened(browser, file, **context):
    """A page whose console errors, and requests to anywhere else, are listed; none is answered."""
    bad = []

    def answer(route):
        url = route.request.url
        if url.startswith(ALLOWED):
            route.continue_()
        else:
            bad.append(f"request to {url}")
            route.abort()

    site = browser.new_context(offline=True, **context)
    page = site.new_page()
    page.route("**/*", answer)
    page.on("console", lambda m: bad.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda error: bad.append(str(error)))
    page.goto(file.as_uri())
    try:
        yield page, bad
    finally:
        site.close()
