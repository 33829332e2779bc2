"""Where photos come from: one reader a layout, and the registry that finds the right one."""
