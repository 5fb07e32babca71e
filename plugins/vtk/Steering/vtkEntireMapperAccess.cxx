// SPDX-License-Identifier: MIT OR Apache-2.0
#include "vtkEntireMapperAccess.h"

#include "vtkFixedPointVolumeRayCastMapper.h"
#include "vtkGPUVolumeRayCastMapper.h"
#include "vtkImageData.h"
#include "vtkMultiBlockVolumeMapper.h"
#include "vtkSmartVolumeMapper.h"
#include "vtkVolumeMapper.h"

#include <algorithm>
#include <mutex>
#include <utility>

namespace
{
// Access to the protected mappers and settings of vtkSmartVolumeMapper: a derived class may name these members.
struct SmartMembers : vtkSmartVolumeMapper
{
  static void Inner(vtkSmartVolumeMapper* smart, std::vector<vtkEntire::LeafMapper>& found)
  {
    vtkVolumeMapper* const inner[] = { smart->*&SmartMembers::GPUMapper,
      smart->*&SmartMembers::GPULowResMapper, smart->*&SmartMembers::RayCastMapper };
    for (vtkVolumeMapper* mapper : inner)
    {
      if (mapper)
      {
        found.push_back({ mapper, smart, vtkGPUVolumeRayCastMapper::SafeDownCast(mapper) != nullptr });
      }
    }
  }

  static void Write(vtkSmartVolumeMapper* smart, const vtkEntire::SmartSettings& settings)
  {
    smart->*&SmartMembers::AutoAdjustSampleDistances = settings.AutoAdjust;
    smart->*&SmartMembers::InteractiveAdjustSampleDistances = settings.InteractiveAdjust;
    smart->*&SmartMembers::SampleDistance = settings.SampleDistance;
  }
};

struct SpacingMembers : vtkVolumeMapper
{
  static double Adjusted(vtkVolumeMapper* mapper, double spacing[3], int extent[6])
  {
    return (mapper->*&SpacingMembers::SpacingAdjustedSampleDistance)(spacing, extent);
  }
};

// Access to the mappers of vtkMultiBlockVolumeMapper, which are private without an accessor. An explicit instantiation
// of a template may name private members. Find() returns the pointer to the member that the instantiation names.
template <typename Tag, typename Tag::Type Member>
struct MemberOf
{
  friend typename Tag::Type Find(Tag) { return Member; }
};
struct BlockMappers
{
  using Type = std::vector<vtkSmartVolumeMapper*> vtkMultiBlockVolumeMapper::*;
  friend Type Find(BlockMappers);
};
template struct MemberOf<BlockMappers, &vtkMultiBlockVolumeMapper::Mappers>;

// Access to the settings, which are protected members with the same names in the GPU and the fixed-point mapper.
template <class Mapper>
struct SettingsMembers : Mapper
{
  static vtkEntire::MapperSettings Read(Mapper* mapper)
  {
    vtkEntire::MapperSettings settings;
    settings.SampleDistance = mapper->*&SettingsMembers::SampleDistance;
    settings.ImageSampleDistance = mapper->*&SettingsMembers::ImageSampleDistance;
    settings.AutoAdjust = mapper->*&SettingsMembers::AutoAdjustSampleDistances;
    settings.Lock = mapper->*&SettingsMembers::LockSampleDistanceToInputSpacing;
    return settings;
  }

  static void Write(Mapper* mapper, const vtkEntire::MapperSettings& settings)
  {
    mapper->*&SettingsMembers::SampleDistance = settings.SampleDistance;
    mapper->*&SettingsMembers::ImageSampleDistance = settings.ImageSampleDistance;
    mapper->*&SettingsMembers::AutoAdjustSampleDistances = settings.AutoAdjust;
    mapper->*&SettingsMembers::LockSampleDistanceToInputSpacing = settings.Lock;
  }
};
// The render mode of vtkSmartVolumeMapper for ANARI; -1 if this VTK has none.
template <class Mapper>
constexpr auto AnariMode(int) -> decltype(static_cast<int>(Mapper::AnariRenderMode))
{
  return Mapper::AnariRenderMode;
}
template <class Mapper>
constexpr int AnariMode(long)
{
  return -1;
}

// VolumetricScatteringBlending of a GPU mapper; 0 if this VTK does not have the property.
template <class Mapper>
auto Scattering(Mapper* mapper, int) -> decltype(static_cast<float>(mapper->GetVolumetricScatteringBlending()))
{
  return mapper->GetVolumetricScatteringBlending();
}
template <class Mapper>
float Scattering(Mapper*, long)
{
  return 0;
}

using GpuMembers = SettingsMembers<vtkGPUVolumeRayCastMapper>;
using FixedMembers = SettingsMembers<vtkFixedPointVolumeRayCastMapper>;

template <class T>
void Keep(T& own, const T& now, const T& written)
{
  if (now != written)
  {
    own = now;
  }
}

// Claimed mappers, each with the object that has claimed it. A list is fast enough, since few mappers are claimed.
std::mutex ClaimsMutex;
std::vector<std::pair<const vtkVolumeMapper*, const void*>>& Claims()
{
  static std::vector<std::pair<const vtkVolumeMapper*, const void*>> claims;
  return claims;
}
}

namespace vtkEntire
{
//------------------------------------------------------------------------------
void FindLeafMappers(vtkAbstractVolumeMapper* mapper, std::vector<LeafMapper>& found)
{
  if (auto* blocks = vtkMultiBlockVolumeMapper::SafeDownCast(mapper))
  {
    for (vtkSmartVolumeMapper* block : blocks->*Find(BlockMappers()))
    {
      FindLeafMappers(block, found);
    }
  }
  else if (auto* smart = vtkSmartVolumeMapper::SafeDownCast(mapper))
  {
    SmartMembers::Inner(smart, found);
  }
  else if (auto* cpu = vtkFixedPointVolumeRayCastMapper::SafeDownCast(mapper))
  {
    found.push_back({ cpu, nullptr, false });
  }
  else if (auto* gpu = vtkGPUVolumeRayCastMapper::SafeDownCast(mapper))
  {
    found.push_back({ gpu, nullptr, true });
  }
}

//------------------------------------------------------------------------------
std::string Refusal(vtkAbstractVolumeMapper* mapper)
{
  if (auto* blocks = vtkMultiBlockVolumeMapper::SafeDownCast(mapper))
  {
    // Inner mappers exist only after the first frame. All of them have the same render mode.
    const auto& inner = blocks->*Find(BlockMappers());
    return inner.empty() ? std::string() : Refusal(inner[0]);
  }
  if (auto* smart = vtkSmartVolumeMapper::SafeDownCast(mapper))
  {
    const int mode = smart->GetRequestedRenderMode();
    const bool ospray = mode == vtkSmartVolumeMapper::OSPRayRenderMode;
    if (ospray || mode == AnariMode<vtkSmartVolumeMapper>(0))
    {
      return std::string("vtkSmartVolumeMapper is told to draw by ") + (ospray ? "OSPRay" : "ANARI") +
        ", which has no sample distance that could be set; the modes Default, GPU and RayCast can be steered";
    }
    return {};
  }
  if (mapper && (mapper->IsA("vtkFixedPointVolumeRayCastMapper") || mapper->IsA("vtkGPUVolumeRayCastMapper")))
  {
    return {};
  }
  return std::string(mapper ? mapper->GetClassName() : "a volume without a mapper") +
    " cannot be steered; vtkFixedPointVolumeRayCastMapper, vtkGPUVolumeRayCastMapper, vtkSmartVolumeMapper "
    "and vtkMultiBlockVolumeMapper can";
}

//------------------------------------------------------------------------------
bool Jitters(vtkVolumeMapper* mapper, bool gpu)
{
  return gpu && static_cast<vtkGPUVolumeRayCastMapper*>(mapper)->GetUseJittering();
}

bool Scatters(vtkVolumeMapper* mapper, bool gpu)
{
  return gpu && Scattering(static_cast<vtkGPUVolumeRayCastMapper*>(mapper), 0) > 0;
}

//------------------------------------------------------------------------------
double SpacingAdjustedSampleDistance(vtkVolumeMapper* mapper, vtkImageData* image)
{
  return SpacingMembers::Adjusted(mapper, image->GetSpacing(), image->GetExtent());
}

//------------------------------------------------------------------------------
MapperSettings MapperSettings::Read(vtkVolumeMapper* mapper, bool gpu)
{
  return gpu ? GpuMembers::Read(static_cast<vtkGPUVolumeRayCastMapper*>(mapper))
             : FixedMembers::Read(static_cast<vtkFixedPointVolumeRayCastMapper*>(mapper));
}

void MapperSettings::Write(vtkVolumeMapper* mapper, bool gpu) const
{
  if (gpu)
  {
    GpuMembers::Write(static_cast<vtkGPUVolumeRayCastMapper*>(mapper), *this);
  }
  else
  {
    FixedMembers::Write(static_cast<vtkFixedPointVolumeRayCastMapper*>(mapper), *this);
  }
}

MapperSettings MapperSettings::Keeping(const MapperSettings& now, const MapperSettings& written) const
{
  MapperSettings kept = *this;
  Keep(kept.SampleDistance, now.SampleDistance, written.SampleDistance);
  Keep(kept.ImageSampleDistance, now.ImageSampleDistance, written.ImageSampleDistance);
  Keep(kept.AutoAdjust, now.AutoAdjust, written.AutoAdjust);
  Keep(kept.Lock, now.Lock, written.Lock);
  return kept;
}

//------------------------------------------------------------------------------
SmartSettings SmartSettings::Read(vtkSmartVolumeMapper* mapper)
{
  return { mapper->GetAutoAdjustSampleDistances(), mapper->GetInteractiveAdjustSampleDistances(),
    mapper->GetSampleDistance() };
}

void SmartSettings::Write(vtkSmartVolumeMapper* mapper) const
{
  SmartMembers::Write(mapper, *this);
}

SmartSettings SmartSettings::Keeping(const SmartSettings& now, const SmartSettings& written) const
{
  SmartSettings kept = *this;
  Keep(kept.AutoAdjust, now.AutoAdjust, written.AutoAdjust);
  Keep(kept.InteractiveAdjust, now.InteractiveAdjust, written.InteractiveAdjust);
  Keep(kept.SampleDistance, now.SampleDistance, written.SampleDistance);
  return kept;
}

//------------------------------------------------------------------------------
bool ClaimMapper(const vtkVolumeMapper* mapper, const void* who)
{
  const std::lock_guard<std::mutex> lock(ClaimsMutex);
  auto& claims = Claims();
  const auto at =
    std::find_if(claims.begin(), claims.end(), [mapper](const auto& each) { return each.first == mapper; });
  if (at != claims.end())
  {
    return at->second == who;
  }
  claims.emplace_back(mapper, who);
  return true;
}

void ReleaseClaim(const void* who)
{
  const std::lock_guard<std::mutex> lock(ClaimsMutex);
  auto& claims = Claims();
  claims.erase(
    std::remove_if(claims.begin(), claims.end(), [who](const auto& each) { return each.second == who; }),
    claims.end());
}
}
