"""The product model: total state with mounting and flexure, closed loop; for recorded pairs too."""
