"""Camera models: projection, calibration files, image windows, masks of projected shapes."""
