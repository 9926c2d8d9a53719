"""Classical multi-view geometry, jitted: bundle adjustment of a window and dense depth by plane sweeping."""
