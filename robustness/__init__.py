"""Programs that damage, kill, flood and interrupt: `make fuzz`, `kills`, `soak`, `attacks`."""
