"""The study "product": total state with mounting and flexure, closed loop; recorded pairs too."""
