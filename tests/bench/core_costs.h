// SPDX-License-Identifier: Apache-2.0
// What core_table measures beside the fixed ways: a row of a table each, for one set.
#pragma once

#include "core_sets.h"

/// A tint, and a density of three channels, over grey: the first channel, which is the same, sets
/// the rate, so that look-ups are the same.
void printColour(const Set& set);

/// Combs, which are none of the fixed ways: RMS errors, and times over exact integration.
void printCombs(const Set& set);

/// Sixteen samples of a ray, which share what it crosses and its plan, over sixteen times one.
void printSamples(const Set& set);

/// Single rays, rays that miss, and two cores.
void printCalls(const Set& set);
