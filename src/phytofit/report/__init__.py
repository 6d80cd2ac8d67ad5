"""Reports that a browser shows without anything else: one HTML file, pictures inside."""

from phytofit.report.page import agreement_page, agreement_table, trial_page
from phytofit.report.save import save_validation

__all__ = ["agreement_page", "agreement_table", "save_validation", "trial_page"]
