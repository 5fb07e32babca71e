// SPDX-License-Identifier: MIT OR Apache-2.0
/**
 * @class   vtkEntireSteering
 * @brief   holds a volume's frames to a target time
 *
 * Attached to a volume in a renderer, vtkEntireSteering predicts what the next frame will cost, sets the
 * sample distance (and, where that is not enough, the image sample distance) of the volume's mapper before
 * the mapper draws, and learns from the time that the frame then took. It works with
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
 * are changed for the frame alone: a GPU mapper's on its VolumeMapperRenderStartEvent, to be put back on its
 * VolumeMapperRenderEndEvent; a fixed-point mapper's, which takes them before it announces its start, on the
 * renderer's StartEvent, to be put back on the renderer's EndEvent. Between frames, and after Detach(), the
 * mapper is as the application left it, its MTime included: nobody hears of what is set for a frame. What the
 * application sets during a frame is kept. Frames are never drawn finer than the mapper's own sample distance,
 * unless FinestSampleDistance says so.
 *
 * Observers of any event of the window, the renderer, the mapper, its pipeline and of vtkEntireSteering
 * itself may call any of its functions and may drop the last reference to it. Warnings are said at the end of
 * the frame. Two vtkEntireSteering of one volume in one renderer do not work together: one of them steers,
 * the Status of the other says so.
 *
 * Still frames, those for which the render window asks for less than StillUpdateRate frames per second, are
 * drawn by VTK alone, pixel for pixel; their times are learned from. So are frames that cannot be predicted:
 * GetStatus() then says why. What is drawn for a hardware selector (picking) is left to VTK and is no frame.
 *
 * No model file is needed. Without one a linear cost model starts from rough costs and learns the mapper and
 * the device from the first frames on; with one (see `entire train`) the first frame is predicted too.
 *
 * Not known to the prediction, and so left to what is learned from frame to frame: clipping planes, geometry
 * in front of the volume, gradient opacity, 2D transfer functions, masks, cropping other than to a box, and
 * all but one of several independent components.
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
   * Invoked after every frame of the window in which the volume was drawn, steered or not, when the read-outs
   * below are up to date.
   */
  enum EventIds
  {
    FrameEvent = 1000 + 737
  };

  /**
   * Clocks for a frame's time.
   */
  enum Clocks
  {
    /// Time on the wall: the clock "wall" of models and of saved states.
    WALL = 0,
    /// Processor time of the process, all threads together: for renderers on the CPU of a shared machine. The
    /// clock "cpu" of models and of saved states.
    PROCESS_CPU = 1
  };

  /**
   * Steers this volume in this renderer from its next frame on; an earlier attachment ends. The mapper may be
   * exchanged later. Neither object is kept alive. While the volume is not among the renderer's props nothing
   * is planned. A volume that the mapper has already is read here, at once (see GetVolumeTime()): set Clock,
   * ModelFileName, Tolerance and MissRate before, or it is read again. Returns false, sets Status and reports
   * an error where there is nothing to attach to.
   */
  bool Attach(vtkRenderer* renderer, vtkVolume* volume);

  /**
   * True if Attach() takes a volume with this mapper.
   */
  static bool CanSteer(vtkAbstractVolumeMapper* mapper);

  /**
   * Returns the reason why Attach() refuses a volume with this mapper; empty if it accepts it. A vtkSmartVolumeMapper in
   * the render modes OSPRay and ANARI cannot be steered; if it is set to one while it is steered, VTK draws without
   * steering, and Status says why, until it is set to another.
   */
  static std::string GetRefusal(vtkAbstractVolumeMapper* mapper);

  /**
   * Releases the volume and drops the learned state. The mapper gets the application's settings.
   */
  void Detach();

  ///@{
  /**
   * The arguments of Attach(), or nullptr.
   */
  vtkRenderer* GetRenderer();
  vtkVolume* GetVolume();
  ///@}

  ///@{
  /**
   * Steering of frames, on or off. Default true.
   */
  vtkSetMacro(Enabled, bool);
  vtkGetMacro(Enabled, bool);
  vtkBooleanMacro(Enabled, bool);
  ///@}

  ///@{
  /**
   * Seconds that a whole frame of the window may take, everything else that it draws included. 0, the
   * default, takes them from the window: 1 / DesiredUpdateRate.
   */
  vtkSetClampMacro(TargetFrameTime, double, 0.0, 10000.0);
  vtkGetMacro(TargetFrameTime, double);
  ///@}

  ///@{
  /**
   * The quality floor: the coarsest sample distance, as a multiple of the smallest voxel spacing. Default 8.
   */
  vtkSetClampMacro(CoarsestSampleDistance, double, 1.0 / 64, 4096.0);
  vtkGetMacro(CoarsestSampleDistance, double);
  ///@}

  ///@{
  /**
   * The finest sample distance, as a multiple of the smallest voxel spacing. 0, the default, is the mapper's
   * own.
   */
  vtkSetClampMacro(FinestSampleDistance, double, 0.0, 4096.0);
  vtkGetMacro(FinestSampleDistance, double);
  ///@}

  ///@{
  /**
   * The coarsest image sample distance: pixels between rays along each side of the image. Ray step and image
   * are coarsened together, since that changes the picture least. Default 4; 1 leaves the image's resolution
   * alone.
   */
  vtkSetClampMacro(CoarsestImageSampleDistance, double, 1.0, 100.0);
  vtkGetMacro(CoarsestImageSampleDistance, double);
  ///@}

  ///@{
  /**
   * Law of the picture error and time of coarser steps and smaller images: image weight, step
   * exponent, image exponent and share of rays as entire_session_set_quality() has them. They decide what of the
   * two is coarsened first where a frame must be faster. Two sets: of vtkFixedPointVolumeRayCastMapper and of
   * vtkGPUVolumeRayCastMapper. With an image weight of 0, the default, they are what the model states of this
   * mapper's pictures (entire_session_record_picture; in Python entire.vtk.calibrate() measures them), and where it
   * states nothing, what was measured with VTK 9.1 (lab/scripts/vtk/tradeoff.py).
   */
  vtkSetVector4Macro(FixedPointQuality, double);
  vtkGetVector4Macro(FixedPointQuality, double);
  vtkSetVector4Macro(GPUQuality, double);
  vtkGetVector4Macro(GPUQuality, double);
  ///@}

  ///@{
  /**
   * A frame is a still one, and not steered, where the window's DesiredUpdateRate is below this. Default 1,
   * as vtkSmartVolumeMapper has it. 0 steers every frame: set it, and a TargetFrameTime, where no interactor
   * sets rates.
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
   * Excess over the target above which a frame counts as missed, as a share of the target, and the
   * share of frames that may be missed. Default 0.25 and 0.02. A changed value starts learning anew.
   */
  vtkSetClampMacro(Tolerance, double, 0.0, 10.0);
  vtkGetMacro(Tolerance, double);
  vtkSetClampMacro(MissRate, double, 1.0e-4, 0.5);
  vtkGetMacro(MissRate, double);
  ///@}

  ///@{
  /**
   * A model file from `entire train`, or nullptr for none. A file that cannot be used switches steering off;
   * Status says why. A changed name starts learning anew. Of a model of another clock than Clock a warning says
   * that its scale is learned from the first frames; it is given once for each change of either.
   */
  vtkSetFilePathMacro(ModelFileName);
  vtkGetFilePathMacro(ModelFileName);
  ///@}

  /**
   * The clock whose seconds the model predicts, as its file states it: "cpu", "wall" or "device". nullptr where it
   * states none, where no model was read yet, and while nothing is attached.
   */
  const char* GetModelClock();

  ///@{
  /**
   * Writes what was learned of the mapper that was drawn last to a file, and starts from such a file: now (or
   * at Attach()), and whenever learning starts anew, until Reset() or Detach(). A file is written whole or
   * not at all. Read are regular files of at most 1 MiB. A file is bound to the model, the class of the mapper
   * and Clock: another's is refused, or dropped with a warning where it was loaded before Attach(). Return
   * false, set Status and report an error on failure.
   */
  bool SaveState(VTK_FILEPATH const char* fileName);
  bool LoadState(VTK_FILEPATH const char* fileName);
  ///@}

  /**
   * Resets the learned state.
   */
  void Reset();

  ///@{
  /**
   * Read-outs of the last frame, seconds by the chosen clock; NaN where there is none. Predicted is of the
   * mapper's work alone, as is Measured; FrameTime is of the whole frame. ShareTime is what the mapper was given
   * of the target: all that steer in a window by the same clock share its frame's time, also two eyes and several
   * renderers, and are coarsened alike. The sample distance is in the unit of the spacing, as the mapper has it. ObserverTime is what everything that vtkEntireSteering did during the
   * frame took, whatever Clock is by the wall clock; the time that pipelines, the graphics device and observers
   * of FrameEvent took meanwhile is no part of it.
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
   * Reason of the last frame's settings: a word such as "fits" or "held", "still", "off", or "fallback".
   */
  vtkGetStringMacro(Reason);

  /**
   * Reason why the last frame was not steered, or an error; empty without either.
   */
  vtkGetStringMacro(Status);

  ///@{
  /**
   * Frames since Attach(): steered ones, and those that VTK drew on its own because they could not be
   * predicted.
   */
  vtkGetMacro(NumberOfSteeredFrames, vtkIdType);
  vtkGetMacro(NumberOfFallbackFrames, vtkIdType);
  ///@}

  ///@{
  /**
   * Number of readings of the voxels and of the transfer function since Attach(): at first, and where they changed.
   */
  vtkGetMacro(NumberOfVolumeReadings, vtkIdType);
  vtkGetMacro(NumberOfTransferFunctionReadings, vtkIdType);
  ///@}

  /**
   * Seconds of the last reading of a volume (at its first frame, and when it changes).
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
