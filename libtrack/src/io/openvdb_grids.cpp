// SPDX-License-Identifier: Apache-2.0
#include "openvdb_grids.h"

namespace openvdb {
OPENVDB_USE_VERSION_NAMESPACE
namespace OPENVDB_VERSION_NAME {

template class tree::Tree<FloatTree::RootNodeType>;
template class tree::Tree<DoubleTree::RootNodeType>;
template class tree::Tree<Vec3STree::RootNodeType>;
template class tree::Tree<Vec3DTree::RootNodeType>;
template class Grid<FloatTree>;
template class Grid<DoubleTree>;
template class Grid<Vec3STree>;
template class Grid<Vec3DTree>;

}  // namespace OPENVDB_VERSION_NAME
}  // namespace openvdb
