"""What is wrong with a drive, from its samples: findings in plain words, the one that explains the others first."""

from ipmsm_can.diagnosis.diagnose import diagnose
from ipmsm_can.diagnosis.finding import Checked, Evidence, Finding, Plot, Report, Series, Severity

__all__ = ["Checked", "Evidence", "Finding", "Plot", "Report", "Series", "Severity", "diagnose"]
