// Edge-directed demosaicing with median filtered colour differences, in three passes:
// green_or_difference, spread_differences, freeman.
#include "demosaic_edge_directed.cl"
#include "demosaic_median.cl"
