"""`python -m zsp_lite` is `zsp-lite`."""

import sys

from zsp_lite.cli.main import main

sys.exit(main())
