"""Other people's recordings become episodes: bags, LeRobot data sets, videos."""
