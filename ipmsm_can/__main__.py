"""`python -m ipmsm_can` is `ipmsm-can`."""

from ipmsm_can.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
