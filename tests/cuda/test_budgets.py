"""Every kernel that a scenario launches stays within its budget on real architectures."""

from __future__ import annotations

import pytest

from tests.cuda.harness import Devices
from tools.cudacheck.budgets import BUDGETS_FILE, load_budgets, violations
from tools.cudacheck.environment import require_program
from tools.cudacheck.failures import MissingToolError

pytestmark = pytest.mark.cuda_check


@pytest.mark.long
def test_every_kernel_keeps_to_its_budget(devices: Devices) -> None:
    try:
        require_program("ptxas")
    except MissingToolError as error:
        pytest.skip(str(error))
    rows, budgets = devices.usage(), load_budgets(BUDGETS_FILE)
    broken = violations(rows, budgets)
    assert not broken, "\n".join(broken)
    assert budgets.keys() == {row.kernel for row in rows}  # none of a kernel that no scenario launches
