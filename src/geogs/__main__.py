"""``python -m geogs``."""

import sys

from geogs_start import main

sys.exit(main())
