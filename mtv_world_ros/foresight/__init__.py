"""What objects will do under a plan: solids from masks, futures of them on MuJoCo."""
