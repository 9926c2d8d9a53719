"""What everything stands on: pytrees, small algebra, the camera, clustering and nearest neighbours."""
