// SPDX-License-Identifier: Apache-2.0
// OpenVDB, with the grids that can be a density or part of a sidecar. Their code is compiled once,
// in openvdb_grids.cpp: made anew in every file that creates or reads one, it takes most of the
// build.
#pragma once

#include <openvdb/openvdb.h>

namespace openvdb {
OPENVDB_USE_VERSION_NAMESPACE
namespace OPENVDB_VERSION_NAME {

extern template class tree::Tree<FloatTree::RootNodeType>;
extern template class tree::Tree<DoubleTree::RootNodeType>;
extern template class tree::Tree<Vec3STree::RootNodeType>;
extern template class tree::Tree<Vec3DTree::RootNodeType>;
extern template class Grid<FloatTree>;
extern template class Grid<DoubleTree>;
extern template class Grid<Vec3STree>;
extern template class Grid<Vec3DTree>;

}  // namespace OPENVDB_VERSION_NAME
}  // namespace openvdb
