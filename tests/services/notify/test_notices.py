"""What people are told of, in which words, and how often."""

from __future__ import annotations

from decimal import Decimal

from msgspec.structs import replace

from tests.services.metrics.test_figures import began, over
from zscout.messages import BookingRecord, LoadReport, Who
from zscout.rcm.steps import BookedDanger
from zscout.scheduling.model import ArcRequest, Outcome
from zscout.scheduling.reason import Party, Reason, ReasonCode
from zscout.services.notify.notices import MAX_BODY, CertificateNotices, HoldNotices, Notification, booking_notice
from zscout.services.notify.rate_limit import RateLimit
from zscout.services.rcm.booked_dates import SKIPPED
from zscout.services.rcm.digest import Began, Over
from zscout.types import SECOND

ADA = Who(user="ada", host="ws1", command="survey.py")


def of(who: Who | None, waited: float) -> Began:
    request = ArcRequest("ws1/c/one", "ws1/c", {"robot/a": {}}, 3, SECOND, label="survey", who=who)
    return began()._replace(request=request, waited=round(waited * SECOND))


def test_a_grant_is_told_to_its_user_after_a_wait_of_so_long() -> None:
    told: list[Notification] = []
    notices = HoldNotices("lab", 60 * SECOND, told.append)
    for one in (of(ADA, 59), of(ADA, 3_000), of(None, 9_000), began(waited=None)):
        notices.on_began(one)
    assert {one[0] for one in told} == {"yours_now"}
    assert [one[1:] for one in told] == [
        ("ada", "zscout lab: survey is yours now", "survey (ada@ws1) holds robot/a after a wait of 50 min"),
        ("ws1", "zscout lab: survey is yours now", "survey (ws1/c) holds robot/a after a wait of 2 h 30 min"),
    ]


def test_what_starts_at_once_is_no_news_whatever_the_limit() -> None:
    told: list[Notification] = []
    HoldNotices("lab", 0, told.append).on_began(of(ADA, 0))
    assert told == []


def test_who_was_preempted_is_told_by_whom_and_why() -> None:
    told: list[Notification] = []
    notices = HoldNotices("lab", 0, told.append)
    by = Party("ws2/d/x", "drive", 10, Who(user="bob", host="ws2", command="drive.py", comment="a visitor is here"))
    lost = Over(of(ADA, 0), 90 * SECOND, Outcome.PREEMPTED, Reason(ReasonCode.PREEMPTED, by=(by,)), requeued=True)
    notices.on_over(lost)
    notices.on_over(over(of(ADA, 0), 90))
    assert told == [
        Notification(
            "preempted",
            "ada",
            "zscout lab: survey was preempted",
            "survey (ada@ws1) held robot/a for 1 min 30 s: "
            "preempted by drive (bob@ws2), priority 10: a visitor is here; it waits again",
        )
    ]


def test_who_holds_an_unwell_device_is_notified_and_else_nobody_in_particular() -> None:
    told: list[Notification] = []
    notices = HoldNotices("lab", 0, told.append)
    notices.on_unwell("dut/a", "it reboots", [of(ADA, 0).request])
    notices.on_unwell("dut/a", "", [])
    title = "zscout lab: dut/a is "
    assert told == [
        Notification(
            "device_unwell", "ada", f"{title}unwell", "survey (ada@ws1) keeps it until it is lost: it reboots"
        ),
        Notification("device_unwell", "", f"{title}well again", "it is granted again"),
    ]


def test_whose_booking_is_in_danger_is_told_why_and_when_it_is_safe_again() -> None:
    minute, zone = Decimal(60), "Europe/Berlin"
    record = BookingRecord("b", "survey", {"robot/a": {}}, 0, 1_800_000_000, minute, minute, zone, who=ADA, owner="ws1")
    told = [booking_notice("lab", BookedDanger(record, record.start, why)) for why in ("robot/a is away", "")]
    assert {one[:2] for one in told} == {("booking_in_danger", "ada")}
    assert [one[2:] for one in told] == [
        ("zscout lab: your booking survey is in danger", "robot/a from 2027-01-15 09:00 CET on: robot/a is away"),
        ("zscout lab: your booking survey is safe again", "robot/a from 2027-01-15 09:00 CET on"),
    ]
    skipped = booking_notice("lab", BookedDanger(record, record.start, SKIPPED, over=True))
    assert skipped[2:] == (
        "zscout lab: your booking survey has lapsed",
        "robot/a from 2027-01-15 09:00 CET on: the fleet's clock was put forward past it",
    )
    # A zone that only others know.
    mars = booking_notice("lab", BookedDanger(replace(record, zone="Mars/Olympus"), record.start, "robot/a is away", 2))
    assert mars.body == "robot/a from 2027-01-15 08:00 UTC on, and 2 later dates: robot/a is away"


def test_others_words_are_one_line_and_bounded() -> None:
    told: list[Notification] = []
    notices = HoldNotices("lab", 0, told.append)
    notices.on_began(of(ADA, 100)._replace(rcs=("robot/a\n\x1b[2J",) * 500))
    assert len(told[0].body) == MAX_BODY
    assert told[0].body.isprintable()


def report(host: str, left: float | None, *, renew: bool) -> LoadReport:
    return LoadReport(host, 1, 1, (0, 0, 0), 0, 1, 2, certificate_ends_in=left, renew=renew)


def test_a_certificate_that_ends_soon_is_told_once_and_again_after_it_was_renewed() -> None:
    notices = CertificateNotices("lab")
    soon = report("anvil", 12.25 * 86_400, renew=True)
    (told,) = notices.look([soon, report("bellows", 9e6, renew=False), report("plain", None, renew=False)])
    assert told == Notification(
        "certificate_ends",
        "",
        "zscout lab: the certificate of anvil expires in 12.2 days",
        "renew it: zscout cert renew",
    )
    assert notices.look([soon]) == []
    assert notices.look([report("anvil", 9e6, renew=False)]) == []
    assert notices.look([report("anvil", -5, renew=True)])[0].title.endswith("anvil has expired")


def test_a_url_is_sent_so_many_a_minute() -> None:
    limit = RateLimit(3)
    assert [limit.allows(SECOND) for _ in range(5)] == [True, True, True, False, False]
    # A third of a minute for each.
    assert [limit.allows(second * SECOND) for second in (20, 21, 22, 41, 500)] == [False, True, False, True, True]
    assert [limit.allows(500 * SECOND) for _ in range(3)] == [True, True, False]
