// SPDX-License-Identifier: MIT OR Apache-2.0
#include "vtkEntireSceneReading.h"

#include "vtkAbstractMapper.h"
#include "vtkAssemblyNode.h"
#include "vtkAssemblyPath.h"
#include "vtkCamera.h"
#include "vtkColorTransferFunction.h"
#include "vtkDataArray.h"
#include "vtkImageData.h"
#include "vtkMath.h"
#include "vtkMatrix3x3.h"
#include "vtkMatrix4x4.h"
#include "vtkNew.h"
#include "vtkPiecewiseFunction.h"
#include "vtkPropCollection.h"
#include "vtkRenderer.h"
#include "vtkVolume.h"
#include "vtkVolumeMapper.h"
#include "vtkVolumeProperty.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

namespace
{
// The library's number for a VTK scalar type; 0 if the library does not support the type.
entire_scalar_type ScalarType(int type)
{
  switch (type)
  {
    case VTK_FLOAT:
      return ENTIRE_SCALAR_F32;
    case VTK_DOUBLE:
      return ENTIRE_SCALAR_F64;
    case VTK_CHAR:
      return std::numeric_limits<char>::is_signed ? ENTIRE_SCALAR_I8 : ENTIRE_SCALAR_U8;
    case VTK_SIGNED_CHAR:
      return ENTIRE_SCALAR_I8;
    case VTK_UNSIGNED_CHAR:
      return ENTIRE_SCALAR_U8;
    case VTK_SHORT:
      return ENTIRE_SCALAR_I16;
    case VTK_UNSIGNED_SHORT:
      return ENTIRE_SCALAR_U16;
    case VTK_INT:
      return ENTIRE_SCALAR_I32;
    case VTK_UNSIGNED_INT:
      return ENTIRE_SCALAR_U32;
    case VTK_LONG:
      return sizeof(long) == 8 ? ENTIRE_SCALAR_I64 : ENTIRE_SCALAR_I32;
    case VTK_UNSIGNED_LONG:
      return sizeof(long) == 8 ? ENTIRE_SCALAR_U64 : ENTIRE_SCALAR_U32;
    case VTK_LONG_LONG:
    case VTK_ID_TYPE:
      return ENTIRE_SCALAR_I64;
    case VTK_UNSIGNED_LONG_LONG:
      return ENTIRE_SCALAR_U64;
    default:
      return 0;
  }
}

double Unit(double value)
{
  return std::isnan(value) ? 0.0 : std::min(1.0, std::max(0.0, value));
}

template <class Node>
bool Same(const std::vector<Node>& a, const std::vector<Node>& b)
{
  return a.size() == b.size() && (a.empty() || std::memcmp(a.data(), b.data(), a.size() * sizeof(Node)) == 0);
}

// Cuts the grid's box to the mapper's cropping planes.
std::string Crop(vtkVolumeMapper* mapper, vtkImageData* image, vtkEntire::VolumeKey& key)
{
  const double* planes = mapper->GetCroppingRegionPlanes();
  const double* origin = image->GetOrigin();
  const int* extent = image->GetExtent();
  for (int axis = 0; axis < 3; ++axis)
  {
    const double last = key.Dimensions[axis] - 1;
    const double low = (planes[2 * axis] - origin[axis]) / key.Spacing[axis] - extent[2 * axis];
    const double high = (planes[2 * axis + 1] - origin[axis]) / key.Spacing[axis] - extent[2 * axis];
    if (!(low <= high) || high < 0 || low > last)
    {
      return "the cropping box leaves nothing to draw";
    }
    key.Box[2 * axis] = static_cast<int>(std::max(0.0, std::floor(low)));
    key.Box[2 * axis + 1] = static_cast<int>(std::min(last, std::ceil(high)));
  }
  return {};
}
}

namespace vtkEntire
{
//------------------------------------------------------------------------------
GridStamp GridStamp::Of(vtkVolumeMapper* mapper, vtkImageData* image, vtkVolumeProperty* property)
{
  return { image, image->GetMTime(), mapper, mapper->GetMTime(), property->GetIndependentComponents() != 0 };
}

//------------------------------------------------------------------------------
std::string ReadGrid(
  vtkVolumeMapper* mapper, vtkImageData* image, vtkVolumeProperty* property, VoxelGrid& grid)
{
  int onCells = 0;
  grid.Scalars = vtkAbstractMapper::GetScalars(image, mapper->GetScalarMode(), mapper->GetArrayAccessMode(),
    mapper->GetArrayId(), mapper->GetArrayName(), onCells);
  if (!grid.Scalars)
  {
    return "the mapper's input has no scalars to draw";
  }
  grid.Type = ScalarType(grid.Scalars->GetDataType());
  if (grid.Type == 0)
  {
    return std::string("scalars of type ") + grid.Scalars->GetDataTypeAsString() + " are not supported";
  }
  VolumeKey& key = grid.Key;
  key = VolumeKey();
  key.Array = grid.Scalars;
  key.Time = image->GetMTime();
  grid.Components = grid.Scalars->GetNumberOfComponents();
  // Opacity comes from the first of independent components, and from the last of dependent ones.
  key.Component = property->GetIndependentComponents() ? 0 : grid.Components - 1;
  image->GetDimensions(key.Dimensions.data());
  image->GetSpacing(key.Spacing.data());
  std::size_t voxels = 1;
  for (int& n : key.Dimensions)
  {
    n -= onCells ? 1 : 0;
    if (n < 1)
    {
      return "the mapper's input is empty";
    }
    voxels *= static_cast<std::size_t>(n);
  }
  if (static_cast<std::size_t>(grid.Scalars->GetNumberOfTuples()) != voxels)
  {
    return "the mapper's input has " + std::to_string(grid.Scalars->GetNumberOfTuples()) +
      " scalar values for " + std::to_string(voxels) + " voxels";
  }
  for (int axis = 0; axis < 3; ++axis)
  {
    key.Box[2 * axis] = 0;
    key.Box[2 * axis + 1] = key.Dimensions[axis] - 1;
    key.Spacing[axis] = std::fabs(key.Spacing[axis]);
    if (!(key.Spacing[axis] > 0) || !std::isfinite(key.Spacing[axis]))
    {
      return "the mapper's input has a spacing of " + std::to_string(key.Spacing[axis]) +
        "; it must be finite and not 0";
    }
  }
  if (mapper->GetCropping() && mapper->GetCroppingRegionFlags() == VTK_CROP_SUBVOLUME)
  {
    std::string failure = Crop(mapper, image, key);
    if (!failure.empty())
    {
      return failure;
    }
  }
  grid.Reference = *std::min_element(key.Spacing.begin(), key.Spacing.end());
  for (int axis = 0; axis < 3; ++axis)
  {
    grid.Center[axis] = 0.5 * (key.Box[2 * axis] + key.Box[2 * axis + 1]) + (onCells ? 0.5 : 0.0);
  }
  return {};
}

//------------------------------------------------------------------------------
entire::failure ReadVoxels(const VoxelGrid& grid, std::optional<entire::volume>& volume,
  std::array<double, 2>& range, vtkSmartPointer<vtkDataArray>& kept)
{
  const VolumeKey& key = grid.Key;
  // The finite range, since VTK's mappers ignore infinities, too.
  grid.Scalars->GetFiniteRange(range.data(), key.Component);
  if (!(range[0] <= range[1]))
  {
    return { ENTIRE_INVALID_ARGUMENT, "the scalars have no finite value" };
  }
  if (!(static_cast<float>(range[1]) > static_cast<float>(range[0])))
  {
    range[1] = range[0] + std::max(1.0, std::fabs(range[0]));
  }
  entire::volume_desc desc;
  vtkDataArray* scalars = grid.Scalars;
  std::size_t components = static_cast<std::size_t>(grid.Components);
  std::size_t offset = static_cast<std::size_t>(key.Component);
  if (!scalars->HasStandardMemoryLayout())
  {
    // GetVoidPointer() would copy the whole array and keep the copy as long as the array lives.
    kept.TakeReference(vtkDataArray::CreateDataArray(scalars->GetDataType()));
    kept->SetNumberOfTuples(scalars->GetNumberOfTuples());
    kept->CopyComponent(0, scalars, key.Component);
    scalars = kept;
    components = 1;
    offset = 0;
  }
  const std::size_t stride[3] = { components, components * key.Dimensions[0],
    components * key.Dimensions[0] * key.Dimensions[1] };
  for (int axis = 0; axis < 3; ++axis)
  {
    offset += stride[axis] * key.Box[2 * axis];
    desc.strides[axis] = stride[axis];
    desc.dims[axis] = static_cast<std::size_t>(key.Box[2 * axis + 1] - key.Box[2 * axis] + 1);
    desc.spacing[axis] = static_cast<float>(key.Spacing[axis]);
  }
  desc.scalar_type = grid.Type;
  const bool copied = grid.Type == ENTIRE_SCALAR_I8 || grid.Type == ENTIRE_SCALAR_U32 ||
    grid.Type == ENTIRE_SCALAR_I32 || grid.Type == ENTIRE_SCALAR_F64 || grid.Type == ENTIRE_SCALAR_U64 ||
    grid.Type == ENTIRE_SCALAR_I64;
  desc.ownership = copied ? ENTIRE_VOXELS_COPY : ENTIRE_VOXELS_BORROW;
  desc.voxels = static_cast<const char*>(scalars->GetVoidPointer(0)) + offset * scalars->GetDataTypeSize();
  desc.voxel_count = static_cast<std::size_t>(scalars->GetNumberOfTuples()) * components - offset;
  desc.range[0] = static_cast<float>(range[0]);
  desc.range[1] = static_cast<float>(range[1]);
  auto made = entire::volume::create(desc);
  if (!made)
  {
    return { made.code(), made.message() };
  }
  volume.emplace(std::move(made.value()));
  return { ENTIRE_OK, {} };
}

//------------------------------------------------------------------------------
bool TransferNodes::operator==(const TransferNodes& o) const
{
  return this->Clamping == o.Clamping && this->Unit == o.Unit && this->Range == o.Range &&
    Same(this->Opacities, o.Opacities) && Same(this->Colors, o.Colors);
}

//------------------------------------------------------------------------------
void ReadTransferNodes(
  vtkVolumeProperty* property, const std::array<double, 2>& range, TransferNodes& nodes)
{
  nodes.Opacities.clear();
  nodes.Colors.clear();
  nodes.Range = range;
  nodes.Unit = static_cast<float>(property->GetScalarOpacityUnitDistance(0));
  vtkPiecewiseFunction* opacity = property->GetScalarOpacity(0);
  nodes.Clamping = opacity->GetClamping() != 0;
  if (opacity->GetUseLogScale())
  {
    // The library interpolates nodes by their values, not by logarithms of them, so samples replace the nodes.
    std::array<double, ENTIRE_TABLE_ENTRIES> samples;
    opacity->GetTable(range[0], range[1], ENTIRE_TABLE_ENTRIES, samples.data());
    const double step = (range[1] - range[0]) / (ENTIRE_TABLE_ENTRIES - 1);
    for (int i = 0; i < ENTIRE_TABLE_ENTRIES; ++i)
    {
      nodes.Opacities.push_back({ range[0] + i * step, Unit(samples[i]), 0.5, 0 });
    }
  }
  else
  {
    for (int i = 0; i < opacity->GetSize(); ++i)
    {
      double node[4];
      opacity->GetNodeValue(i, node);
      nodes.Opacities.push_back({ node[0], Unit(node[1]), Unit(node[2]), Unit(node[3]) });
    }
  }
  if (property->GetColorChannels(0) == 3)
  {
    vtkColorTransferFunction* color = property->GetRGBTransferFunction(0);
    for (int i = 0; i < color->GetSize(); ++i)
    {
      double node[6];
      color->GetNodeValue(i, node);
      nodes.Colors.push_back(
        { node[0], { Unit(node[1]), Unit(node[2]), Unit(node[3]) }, Unit(node[4]), Unit(node[5]) });
    }
  }
}

//------------------------------------------------------------------------------
std::string MakeTransferFunction(
  const TransferNodes& nodes, std::optional<entire::transfer_function>& function)
{
  auto made = entire::transfer_function::from_nodes(
    nodes.Opacities, nodes.Colors, nodes.Range[0], nodes.Range[1], nodes.Clamping);
  if (!made)
  {
    return made.message();
  }
  auto unit = made.value().set_unit_distance(nodes.Unit, ENTIRE_UNIT_WORLD);
  if (!unit)
  {
    return unit.message();
  }
  function.emplace(std::move(made.value()));
  return {};
}

//------------------------------------------------------------------------------
double PlacedSpacing(vtkImageData* image, vtkVolume* volume)
{
  const double* placed = volume->GetMatrix()->GetData();
  const double* spacing = image->GetSpacing();
  double least = std::numeric_limits<double>::max();
  for (int axis = 0; axis < 3; ++axis)
  {
    const double length = std::sqrt(placed[axis] * placed[axis] + placed[4 + axis] * placed[4 + axis] +
      placed[8 + axis] * placed[8 + axis]);
    least = std::min(least, std::abs(spacing[axis]) * length);
  }
  return least;
}

//------------------------------------------------------------------------------
vtkMatrix4x4* DrawnMatrix(vtkRenderer* renderer, vtkVolume* volume)
{
  if (!renderer->HasViewProp(volume))
  {
    vtkPropCollection* props = renderer->GetViewProps();
    vtkCollectionSimpleIterator at;
    props->InitTraversal(at);
    while (vtkProp* prop = props->GetNextProp(at))
    {
      prop->InitPathTraversal();
      while (vtkAssemblyPath* path = prop->GetNextPath())
      {
        vtkAssemblyNode* const node = path->GetLastNode();
        if (node->GetViewProp() == volume && node->GetMatrix())
        {
          return node->GetMatrix();
        }
      }
    }
  }
  return volume->GetMatrix();
}

//------------------------------------------------------------------------------
std::string ReadCamera(
  vtkRenderer* renderer, vtkMatrix4x4* placed, vtkImageData* image, const VoxelGrid& grid, entire::frame& frame)
{
  vtkCamera* camera = renderer->GetActiveCamera();
  double toEye[16];
  vtkMatrix4x4::Multiply4x4(camera->GetViewTransformMatrix()->GetData(), placed->GetData(), toEye);
  const int* extent = image->GetExtent();
  double world[3];
  vtkImageData::TransformContinuousIndexToPhysicalPoint(grid.Center[0] + extent[0],
    grid.Center[1] + extent[2], grid.Center[2] + extent[4], image->GetOrigin(), image->GetSpacing(),
    image->GetDirectionMatrix()->GetData(), world);
  const double* direction = image->GetDirectionMatrix()->GetData();
  double axes[3][3];
  double scales[3];
  for (int axis = 0; axis < 3; ++axis)
  {
    for (int row = 0; row < 3; ++row)
    {
      axes[axis][row] = 0;
      for (int k = 0; k < 3; ++k)
      {
        axes[axis][row] += toEye[4 * row + k] * direction[3 * k + axis];
      }
    }
    scales[axis] = vtkMath::Normalize(axes[axis]);
  }
  const double scale = std::cbrt(scales[0] * scales[1] * scales[2]);
  if (!(scale > 0) || !std::isfinite(scale))
  {
    return "the volume's matrix is singular";
  }
  if (std::fabs(vtkMath::Dot(axes[0], axes[1])) > 0.02 || std::fabs(vtkMath::Dot(axes[1], axes[2])) > 0.02 ||
    std::fabs(vtkMath::Dot(axes[2], axes[0])) > 0.02)
  {
    return "the volume's matrix shears the volume; use only rotations, translations and scales";
  }
  // Makes the axes a right-handed orthonormal basis. A mirrored volume then gets the prediction of the volume that is
  // not mirrored.
  double across[3];
  vtkMath::Cross(axes[0], axes[1], across);
  vtkMath::Normalize(across);
  std::copy(across, across + 3, axes[2]);
  vtkMath::Cross(axes[2], axes[0], axes[1]);
  vtkMath::Normalize(axes[1]);

  double eye[3];
  for (int row = 0; row < 3; ++row)
  {
    eye[row] = toEye[4 * row + 3];
    for (int k = 0; k < 3; ++k)
    {
      eye[row] += toEye[4 * row + k] * world[k];
    }
    eye[row] /= scale;
  }
  double angle = camera->GetViewAngle();
  if (camera->GetUseHorizontalViewAngle())
  {
    const int* size = renderer->GetSize();
    angle = 2 *
      vtkMath::DegreesFromRadians(
        std::atan(std::tan(vtkMath::RadiansFromDegrees(0.5 * angle)) * size[1] / std::max(1, size[0])));
  }
  const bool parallel = camera->GetParallelProjection() != 0;
  frame.projection = parallel ? ENTIRE_PROJECTION_PARALLEL : ENTIRE_PROJECTION_PERSPECTIVE;
  frame.parallel_scale = static_cast<float>(camera->GetParallelScale() / scale);
  frame.fov_y = static_cast<float>(angle);
  frame.camera = ENTIRE_CAMERA_VIEW;
  for (int column = 0; column < 3; ++column)
  {
    for (int row = 0; row < 3; ++row)
    {
      frame.view[4 * column + row] = static_cast<float>(axes[column][row]);
    }
    frame.view[4 * column + 3] = 0;
    frame.view[12 + column] = static_cast<float>(eye[column]);
    frame.volume_center[column] = 0;
  }
  frame.view[15] = 1;
  return {};
}

//------------------------------------------------------------------------------
bool IsDrawnBy(vtkRenderer* renderer, vtkVolume* volume)
{
  if (!renderer || !volume)
  {
    return false;
  }
  if (renderer->HasViewProp(volume))
  {
    return true;
  }
  vtkNew<vtkPropCollection> parts;
  vtkPropCollection* props = renderer->GetViewProps();
  vtkCollectionSimpleIterator at;
  props->InitTraversal(at);
  while (vtkProp* prop = props->GetNextProp(at))
  {
    prop->GetVolumes(parts);
  }
  return parts->IsItemPresent(volume) != 0;
}
}
