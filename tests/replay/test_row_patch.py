"""Bad rows give way to sound ones, by brute force over every pattern."""

from __future__ import annotations

import itertools

import pytest
import torch
from no_sync import forbid_sync
from tensordict import TensorDict

from flashdex.replay.codec import RowPatch

NAN = float("nan")


def rows_of(good, first):
    """Rows with numbers from ``first`` in every leaf; bad ones hold NaN."""
    number = torch.arange(first, first + len(good))
    wide = number.float()[:, None].expand(-1, 3).clone()
    wide[~torch.tensor(good)] = NAN
    flags = torch.zeros(len(good), 2, dtype=torch.uint8)
    return TensorDict({"wide": wide, "number": number, "flags": flags}, [len(good)])


@pytest.mark.parametrize("steps", [1, 2])
def test_every_pattern_of_bad_rows(steps):
    patterns = list(itertools.product([False, True], repeat=3))
    for chosen in itertools.product(patterns, repeat=steps):
        patch = RowPatch(torch.device("cpu"), ones=("flags",))
        last = None
        for step, good in enumerate(chosen):
            rows = rows_of(good, first=1 + 10 * step)
            with forbid_sync():
                found = patch(rows, rows["wide"].isfinite().all(-1))
            sound = [1 + 10 * step + i for i, g in enumerate(good) if g]
            for i, is_good in enumerate(good):
                number = 1 + 10 * step + i
                if is_good:
                    expected = number
                elif sound:
                    expected = max((n for n in sound if n < number), default=sound[0])
                else:
                    expected = last or 0
                # all leaves of a row come from one row
                assert found["number"][i] == expected
                assert found["wide"][i].tolist() == [expected] * 3
                assert found["flags"][i].tolist() == [int(expected == 0)] * 2
            last = int(found["number"][-1]) or None
        assert patch.count == sum(not g for good in chosen for g in good)


def test_patched_rows_are_copies():
    rows = rows_of([True, True], first=1)
    found = RowPatch(torch.device("cpu"))(rows, torch.tensor([True, True]))
    rows["wide"].fill_(9)
    assert found["wide"].tolist() == [[1.0] * 3, [2.0] * 3]
