"""Reports as pages: one file each, which needs no network and can be mailed."""
