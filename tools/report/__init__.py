"""The report: one self-contained HTML page out of one log.

Data flow: `read` (log → ReportData) → `series` (decimate, bin) → `charts`/`tables` → `page` (one HTML text).
"""
