"""Which requests are made for ranges: all is covered, gaps are bridged within the budget."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from terrainwave.container.sources.ranges import (
    AIMED_REQUESTS,
    MAX_GAP,
    Budget,
    ByteRange,
    merge_ranges,
)

KIB, MIB = 2**10, 2**20


def n_bytes(ranges):
    return sum(part.length for part in ranges)


def in_a_row(length, gaps):
    """Return ranges of one length with these gaps between them."""
    found = [ByteRange(0, length)]
    for gap in gaps:
        found.append(ByteRange(found[-1].end + gap, length))
    return found


def test_gaps_of_64_kib_in_all_are_bridged_and_more_are_not():
    first, second = ByteRange(0, 10), ByteRange(10 + 65536, 5)
    assert merge_ranges([first, second]) == [ByteRange(0, 65536 + 15)]
    assert merge_ranges([first, ByteRange(11 + 65536, 5)]) == [first, ByteRange(11 + 65536, 5)]
    third = ByteRange(second.end + 100, 5)  # the shorter gap is bridged
    assert merge_ranges([first, second, third]) == [first, ByteRange(second.offset, 110)]


def test_a_quarter_of_what_is_wanted_may_lie_in_gaps():
    first = ByteRange(0, MIB)
    near, far = ByteRange(MIB + 300_000, MIB), ByteRange(MIB + 600_000, MIB)
    assert merge_ranges([first, near]) == [ByteRange(0, 2 * MIB + 300_000)]
    assert merge_ranges([first, far]) == [first, far]
    # However much is wanted, a gap above 1 MiB costs more than a request.
    large, beyond = ByteRange(0, 8 * MIB), ByteRange(8 * MIB + MAX_GAP + 1, MIB)
    assert merge_ranges([large, beyond]) == [large, beyond]


def test_more_may_lie_in_gaps_while_requests_are_more_than_is_aimed_at():
    ranges = in_a_row(50 * KIB, [60 * KIB] * 5 + [300 * KIB] * 12)  # 18 ranges, 900 KiB
    assert len(merge_ranges(ranges)) == 18 - 5 - 3  # one and a half times that: 5 · 60 + 3 · 300
    budget = Budget(13, waste=225 * KIB, most_waste=300 * KIB)
    assert len(merge_ranges(ranges, budget)) == 13
    assert len(merge_ranges(ranges, budget._replace(most_waste=299 * KIB))) == 14
    assert len(merge_ranges(ranges, budget._replace(n_requests=12))) == 13


def test_no_more_gaps_are_bridged_than_the_aim_needs():
    ranges = in_a_row(100 * KIB, [100 * KIB] * 12)
    budget = Budget(AIMED_REQUESTS, waste=0, most_waste=10 * MIB)
    assert len(merge_ranges(ranges, budget)) == AIMED_REQUESTS
    assert merge_ranges(ranges, budget._replace(n_requests=13)) == ranges
    # Earlier rounds have taken all: one more is needed in any case.
    assert len(merge_ranges(ranges, budget._replace(n_requests=-2))) == 1


def test_ranges_that_touch_or_overlap_are_one_request_whatever_the_budget():
    nothing_left = Budget(0, -1, -1)
    ranges = [ByteRange(0, 10), ByteRange(5, 10), ByteRange(15, 5), ByteRange(7, 2)]
    assert merge_ranges(ranges, nothing_left) == [ByteRange(0, 20)]


def test_empty_ranges_need_no_request():
    assert merge_ranges([ByteRange(5, 0), ByteRange(90, 0)]) == []


budgets = st.builds(Budget, st.integers(-3, 20), st.integers(-9, 2**21), st.integers(-9, 2**22))


@given(
    st.lists(st.integers(1, 40 * KIB), min_size=1, max_size=30),
    st.lists(st.integers(1, 40 * KIB), min_size=30, max_size=30),
    budgets,
)
def test_requests_are_disjoint_in_order_and_within_the_budget(lengths, gaps, budget):
    ranges, end = [], 0
    for length, gap in zip(lengths, gaps, strict=False):
        ranges.append(ByteRange(end + gap, length))
        end = ranges[-1].end
    spans = merge_ranges(ranges[::-1], budget)
    assert all(one.end < other.offset for one, other in pairwise(spans))
    n_wasted = n_bytes(spans) - n_bytes(ranges)
    assert n_wasted <= max(0, budget.waste, budget.most_waste)
    # The fewest requests that the budget can buy: bridging the shortest gaps first.
    costs = [sum(sorted(gaps[1 : len(ranges)])[:n]) for n in range(len(ranges))]

    def bought(most):
        return max((n for n, cost in enumerate(costs) if cost <= most), default=0)

    aimed = max(0, len(ranges) - max(budget.n_requests, 1))
    n_bridged = max(bought(budget.waste), min(bought(budget.most_waste), aimed))
    assert len(spans) == len(ranges) - n_bridged
