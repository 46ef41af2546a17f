"""Run the checks; `checks` is a module of its own, because the processes that it starts
import it."""

import sys

from tests.gpu.checks import main

sys.exit(main())
