"""Images, camera infos and joint states become observations."""
