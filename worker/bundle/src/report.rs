//! `report.html` (in the making).
