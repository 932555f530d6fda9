"""The app's server as a browser meets it."""

import urllib.error
import urllib.request

import pytest
from browsers import needs_browser, opened, viewing

pytestmark = needs_browser


@pytest.fixture(scope="module")
def address(shipped):
    with viewing(shipped / "phantom.h5") as address:
        yield address


def refused(address, **headers):
    with pytest.raises(urllib.error.HTTPError) as refusal:
        urllib.request.urlopen(urllib.request.Request(address, headers=headers), timeout=20)
    with refusal.value as answer:
        return answer.code


def test_it_opens_without_complaint_and_asks_nobody_else(browser, address):
    page = opened(browser, address)
    page.wait_for_selector("canvas")
    assert page.complaints == []
    own = address.split("?")[0]
    assert [each for each in page.requests if not each.startswith(own)] == []


def test_without_the_token_or_under_another_name_it_is_closed(address):
    bare = address.split("?")[0]
    assert refused(bare) == 403
    assert refused(f"{bare}?token=wrong") == 403
    assert refused(address, Host="example.org") == 403
