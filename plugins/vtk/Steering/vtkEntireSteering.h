// SPDX-License-Identifier: MIT OR Apache-2.0
/**
 * @class   vtkEntireSteering
 * @brief   holds a volume's frames to a target time
 *
 * Attached to a volume in a renderer, vtkEntireSteering predicts the time of each frame before it is drawn. It
 * sets the sample distance and the image sample distance of the volume's mapper so that the frame takes the
 * target time, and corrects later predictions by the time that the frame took. It works with
 * vtkFixedPointVolumeRayCastMapper, with vtkGPUVolumeRayCastMapper, and with the mappers inside
 * vtkSmartVolumeMapper and vtkMultiBlockVolumeMapper.
 *
 * @code
 * vtkNew<vtkEntireSteering> steering;
 * steering->SetTargetFrameTime(1.0 / 15);
 * steering->Attach(renderer, volume);
 * @endcode
 *
 * The mapper's own settings (sample distances, AutoAdjustSampleDistances, LockSampleDistanceToInputSpacing)
 * are changed only for the frame. Those of a GPU mapper are set on its VolumeMapperRenderStartEvent and
 * restored on its VolumeMapperRenderEndEvent. A fixed-point mapper reads its settings before that event, so
 * they are set on the renderer's StartEvent and restored on the renderer's EndEvent. Between frames, and after
 * Detach(), the mapper has the settings of the application, and its MTime never changes: the settings of a
 * frame are written without an event. Settings that the application changes during a frame are kept. Frames
 * are never drawn finer than the mapper's own sample distance, unless FinestSampleDistance allows it.
 *
 * Observers of any event of the window, the renderer, the mapper, its pipeline and of vtkEntireSteering
 * itself may call any of its functions and may drop the last reference to it. Warnings are raised at the end
 * of the frame. Two vtkEntireSteering of one volume in one renderer do not work together: one of them steers,
 * and the Status of the other says so.
 *
 * A still frame is one for which the render window's DesiredUpdateRate is below StillUpdateRate. VTK draws it
 * without steering, with the same pixels as without this class; its time corrects later predictions. The time
 * of a still frame is not used if the mapper has AutoAdjustSampleDistances and the rate is 0.01 frames per
 * second or more, since VTK may draw such a frame coarsely. If a frame cannot be predicted, VTK draws it
 * without steering, and GetStatus() gives the reason. Rendering for a hardware selector (picking) is left to
 * VTK and does not count as a frame.
 *
 * No model file is needed. Without one, an analytic model (unit costs times estimated work) starts from rough
 * unit costs and learns the speed of the mapper and the device from the first frames. With a model file (see
 * `entire calibrate --data`), the first frame is predicted too.
 *
 * The prediction ignores clipping planes, geometry in front of the volume, gradient opacity, 2D transfer
 * functions, masks, cropping other than to a box, all independent components except the first, and all volumes
 * of a vtkMultiVolume except that of port 0. Their effect on the time is corrected from frame to frame.
 */
#ifndef vtkEntireSteering_h
#define vtkEntireSteering_h

#include "vtkEntireSteeringModule.h" // for export macro
#include "vtkObject.h"

#include <memory> // for std::unique_ptr
#include <string> // for std::string

class vtkAbstractVolumeMapper;
class vtkRenderer;
class vtkVolume;

class VTKENTIRESTEERING_EXPORT vtkEntireSteering : public vtkObject
{
public:
  static vtkEntireSteering* New();
  vtkTypeMacro(vtkEntireSteering, vtkObject);
  void PrintSelf(ostream& os, vtkIndent indent) override;

  /**
   * Invoked after every frame of the window in which the volume was drawn, steered or not. PredictedTime,
   * MeasuredTime and the other read-only properties below are then those of this frame.
   */
  enum EventIds
  {
    FrameEvent = 1000 + 737
  };

  /**
   * Clocks that can time frames.
   */
  enum Clocks
  {
    /// Wall time; "wall" in models and saved states.
    WALL = 0,
    /// Processor time of the process, summed over all threads; for renderers on the CPU of a shared machine.
    /// "cpu" in models and saved states.
    PROCESS_CPU = 1
  };

  /**
   * Steers this volume in this renderer from its next frame on; an earlier attachment ends. The mapper may be
   * exchanged later. Renderer and volume are not kept alive. While the volume is not among the renderer's props,
   * nothing is planned. If the mapper already has its input, the voxels are read here (see GetVolumeTime()). Set
   * Clock, ModelFileName, Tolerance, MissRate and IgnoreLoad before this call; otherwise the voxels are read
   * again. Returns false, sets Status and reports an error if an argument is nullptr or the mapper cannot be
   * steered.
   */
  bool Attach(vtkRenderer* renderer, vtkVolume* volume);

  /**
   * Returns true if Attach() accepts a volume with this mapper.
   */
  static bool CanSteer(vtkAbstractVolumeMapper* mapper);

  /**
   * Returns the reason why Attach() refuses a volume with this mapper; empty if it accepts the volume. A
   * vtkSmartVolumeMapper in the render modes OSPRay and ANARI cannot be steered. While a steered mapper is set to one
   * of these modes, VTK draws without steering, and Status gives the reason.
   */
  static std::string GetRefusal(vtkAbstractVolumeMapper* mapper);

  /**
   * Releases the volume, drops the learned state, and restores the application's settings of the mapper.
   */
  void Detach();

  ///@{
  /**
   * The arguments of Attach(); nullptr if nothing is attached or the object was deleted.
   */
  vtkRenderer* GetRenderer();
  vtkVolume* GetVolume();
  ///@}

  ///@{
  /**
   * Turns steering of frames on or off. Default true.
   */
  vtkSetMacro(Enabled, bool);
  vtkGetMacro(Enabled, bool);
  vtkBooleanMacro(Enabled, bool);
  ///@}

  ///@{
  /**
   * Target time of a whole frame of the window in seconds, including everything else that the window draws.
   * With 0, the default, the target is 1 / DesiredUpdateRate of the window.
   */
  vtkSetClampMacro(TargetFrameTime, double, 0.0, 10000.0);
  vtkGetMacro(TargetFrameTime, double);
  ///@}

  ///@{
  /**
   * The coarsest allowed sample distance, as a multiple of the smallest voxel spacing. Default 8.
   */
  vtkSetClampMacro(CoarsestSampleDistance, double, 1.0 / 64, 4096.0);
  vtkGetMacro(CoarsestSampleDistance, double);
  ///@}

  ///@{
  /**
   * The finest sample distance, as a multiple of the smallest voxel spacing. 0, the default, means the mapper's
   * own sample distance.
   */
  vtkSetClampMacro(FinestSampleDistance, double, 0.0, 4096.0);
  vtkGetMacro(FinestSampleDistance, double);
  ///@}

  ///@{
  /**
   * The coarsest allowed image sample distance: pixels between rays along each side of the image. Default 4; with
   * 1 the image keeps its resolution.
   */
  vtkSetClampMacro(CoarsestImageSampleDistance, double, 1.0, 100.0);
  vtkGetMacro(CoarsestImageSampleDistance, double);
  ///@}

  ///@{
  /**
   * Quality law of vtkFixedPointVolumeRayCastMapper and of vtkGPUVolumeRayCastMapper: picture error and time as
   * functions of sample distance and image sample distance. Of the two, steering coarsens the one that adds less
   * error for the time that it saves. The four numbers are image weight, step exponent, image exponent and ray
   * share, as in entire_session_set_quality(). With an image weight of 0, the default, the law is the model's, if the
   * model was calibrated with pictures of this mapper (entire_session_record_picture(); entire.vtk.calibrate() in
   * Python). Otherwise it is a built-in law, measured with VTK 9.1 (lab/scripts/vtk/tradeoff.py).
   */
  vtkSetVector4Macro(FixedPointQuality, double);
  vtkGetVector4Macro(FixedPointQuality, double);
  vtkSetVector4Macro(GPUQuality, double);
  vtkGetVector4Macro(GPUQuality, double);
  ///@}

  ///@{
  /**
   * A frame is a still frame, and not steered, if the window's DesiredUpdateRate is below this rate in frames
   * per second. Default 1, as InteractiveUpdateRate of vtkSmartVolumeMapper. 0 steers every frame: set it, and a
   * TargetFrameTime, if no interactor sets rates.
   */
  vtkSetClampMacro(StillUpdateRate, double, 0.0, 1.0e10);
  vtkGetMacro(StillUpdateRate, double);
  ///@}

  ///@{
  /**
   * The clock of frame times. Default WALL.
   */
  vtkSetClampMacro(Clock, int, WALL, PROCESS_CPU);
  vtkGetMacro(Clock, int);
  void SetClockToWall() { this->SetClock(WALL); }
  void SetClockToProcessCPU() { this->SetClock(PROCESS_CPU); }
  ///@}

  ///@{
  /**
   * Tolerance is the excess over the target above which a frame counts as missed, as a share of the target.
   * MissRate is the share of frames that may be missed. Default 0.25 and 0.02. A change of either discards the
   * learned state.
   */
  vtkSetClampMacro(Tolerance, double, 0.0, 10.0);
  vtkGetMacro(Tolerance, double);
  vtkSetClampMacro(MissRate, double, 1.0e-4, 0.5);
  vtkGetMacro(MissRate, double);
  ///@}

  ///@{
  /**
   * If true, pictures keep their quality while other programs slow frames down, and frames exceed the target. If
   * the load lasts longer than 32 frames, the slower speed counts as the machine's normal speed from then on, and steps
   * are chosen for it. Default false. A change discards the learned state.
   */
  vtkSetMacro(IgnoreLoad, bool);
  vtkGetMacro(IgnoreLoad, bool);
  vtkBooleanMacro(IgnoreLoad, bool);
  ///@}

  ///@{
  /**
   * A model file from `entire calibrate --data`, or nullptr for none. If the file cannot be used, frames are not steered, and
   * Status gives the reason; a file that is not a model is read again only after a change of the name, Reset() or
   * Attach(). A change of the name discards the learned state. If the model predicts times of another clock than
   * Clock, a warning says that the model's scale is learned from the first frames; the warning is raised once for each
   * change of the model's clock or Clock.
   */
  vtkSetFilePathMacro(ModelFileName);
  vtkGetFilePathMacro(ModelFileName);
  ///@}

  /**
   * The clock whose seconds the model predicts, from the model file: "cpu", "wall" or "device". nullptr if the file
   * states no clock, if no model was read yet, and while nothing is attached.
   */
  const char* GetModelClock();

  ///@{
  /**
   * SaveState() writes the learned state of the mapper that was drawn last to a file, completely or not at all.
   * LoadState() starts from such a file: now, or at Attach() if nothing is attached, and again whenever the learned
   * state is discarded, until Reset() or Detach(). Only regular files of at most 1 MiB are read. A file is valid
   * only for the same model, class of mapper, and Clock: otherwise it is refused, or ignored with a warning if it
   * was loaded before Attach(). Both return false, set Status and report an error on failure.
   */
  bool SaveState(VTK_FILEPATH const char* fileName);
  bool LoadState(VTK_FILEPATH const char* fileName);
  ///@}

  /**
   * Discards the learned state, and a state from LoadState().
   */
  void Reset();

  ///@{
  /**
   * Values of the last frame. Times are seconds of the chosen clock; NaN means that a value is unknown. PredictedTime
   * and MeasuredTime are times of the mappers alone, FrameTime is the time of the window's whole frame. ShareTime is
   * the mapper's share of the target: all vtkEntireSteering in a window with the same clock share the window's frame
   * time, also with two eyes or several renderers, and their mappers are coarsened equally. SampleDistance is in the
   * unit of the spacing, ImageSampleDistance in pixels. ObserverTime is the overhead of vtkEntireSteering in the
   * frame, always in wall time; it excludes pipelines, the graphics device and observers of FrameEvent.
   */
  vtkGetMacro(PredictedTime, double);
  vtkGetMacro(MeasuredTime, double);
  vtkGetMacro(FrameTime, double);
  vtkGetMacro(ShareTime, double);
  vtkGetMacro(SampleDistance, double);
  vtkGetMacro(ImageSampleDistance, double);
  vtkGetMacro(ObserverTime, double);
  ///@}

  /**
   * Reason for the last frame's settings: "still" for a still frame, "off" if Enabled was false, "fallback" if the
   * frame could not be predicted, else the reason of the plan, such as "fits", "held" or "finest allowed".
   */
  vtkGetStringMacro(Reason);

  /**
   * Reason why the last frame was not steered, or the last error; empty if there is neither.
   */
  vtkGetStringMacro(Status);

  ///@{
  /**
   * Number of frames since Attach() that were steered, and number of frames that VTK drew without steering because
   * they could not be predicted. Each drawing of a mapper counts as one frame.
   */
  vtkGetMacro(NumberOfSteeredFrames, vtkIdType);
  vtkGetMacro(NumberOfFallbackFrames, vtkIdType);
  ///@}

  ///@{
  /**
   * Numbers of times that the voxels and the transfer function were read since Attach(): once at first, and after
   * each change.
   */
  vtkGetMacro(NumberOfVolumeReadings, vtkIdType);
  vtkGetMacro(NumberOfTransferFunctionReadings, vtkIdType);
  ///@}

  /**
   * Wall time in seconds of the last reading of a volume's voxels.
   */
  vtkGetMacro(VolumeTime, double);

protected:
  vtkEntireSteering();
  ~vtkEntireSteering() override;

  bool Enabled = true;
  double TargetFrameTime = 0.0;
  double CoarsestSampleDistance = 8.0;
  double FinestSampleDistance = 0.0;
  double CoarsestImageSampleDistance = 4.0;
  double FixedPointQuality[4] = { 0.0, 1.0, 1.0, 0.0 };
  double GPUQuality[4] = { 0.0, 1.0, 1.0, 0.0 };
  double StillUpdateRate = 1.0;
  int Clock = WALL;
  double Tolerance = 0.25;
  double MissRate = 0.02;
  bool IgnoreLoad = false;
  char* ModelFileName = nullptr;

  double PredictedTime;
  double MeasuredTime;
  double FrameTime;
  double ShareTime;
  double SampleDistance;
  double ImageSampleDistance;
  double ObserverTime;
  double VolumeTime;
  char* Reason = nullptr;
  char* Status = nullptr;
  vtkIdType NumberOfSteeredFrames = 0;
  vtkIdType NumberOfFallbackFrames = 0;
  vtkIdType NumberOfVolumeReadings = 0;
  vtkIdType NumberOfTransferFunctionReadings = 0;

private:
  vtkEntireSteering(const vtkEntireSteering&) = delete;
  void operator=(const vtkEntireSteering&) = delete;

  // Sets Status and reports an error. Returns false.
  bool Fail(const std::string& text);

  class vtkInternals;
  std::unique_ptr<vtkInternals> Internals;
};

#endif
