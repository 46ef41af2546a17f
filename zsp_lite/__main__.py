"""`python -m zsp_lite` is `zsp-lite`."""

import sys

from zsp_lite.cli import main

sys.exit(main())
