"""Non-rigid registration of one template to a sequence of scans."""
