"""An independent finite-element reference: scenes, solver, stored frames. Only the accuracy test imports softmode."""
