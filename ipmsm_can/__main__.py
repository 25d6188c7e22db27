"""`python -m ipmsm_can` is `ipmsm-can`."""

from ipmsm_can.cli import main

raise SystemExit(main())
